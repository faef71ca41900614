"""Simulate cameras with other fields of view by cropping images, because confidence must hold for the cameras of real robots.

A camera that covers less of the view grid has other confidence features at the same place. A calibration with a single field of view takes
queries of every other one for out-of-map queries (decision 0126). Stereo rigs are simulated directly (``plans.PAIR_RIGS``).
"""

from dataclasses import dataclass, replace

import numpy as np

from service.registration.points import FOCAL_BASELINE_PX_M
from service.retrieval.query import Query


@dataclass(frozen=True, slots=True)
class Rig:
    """A camera that sees a window in the middle of the simulated image.

    Attributes:
        name: name of the rig in its kinds of queries.
        width: width of the window, as a share of the image's width.
        height: height of the window, as a share of the image's height.
        stereo: the query states a stereo baseline. Registration then uses the noise of stereo matching and a free disparity offset.

    Raises:
        ValueError: the window is empty or exceeds the image.
    """

    name: str
    width: float
    height: float
    stereo: bool

    def __post_init__(self) -> None:
        """Refuse an empty window, and one that exceeds the image."""
        if not (0 < self.width <= 1 and 0 < self.height <= 1):
            raise ValueError(f"rig {self.name}: a window of {self.width:g} x {self.height:g} of the image is not valid")

    def seen(self, query: Query) -> Query:
        """Return the query as this rig would take it: cropped images, and the principal point moved accordingly.

        Args:
            query: a query whose RGB and depth images have the same size.
        """
        camera = query.camera
        left, width = _window(camera.width, self.width)
        top, height = _window(camera.height, self.height)
        cut = replace(camera, width=width, height=height, cx=camera.cx - left, cy=camera.cy - top)
        baseline_m = FOCAL_BASELINE_PX_M / camera.fx if self.stereo else query.baseline_m
        window = np.s_[top : top + height, left : left + width]
        rgb, depth_m = np.ascontiguousarray(query.rgb[window]), np.ascontiguousarray(query.depth_m[window])
        return replace(query, rgb=rgb, depth_m=depth_m, camera=cut, baseline_m=baseline_m)


#: The rigs of the calibration. Small RGB-D cameras see 69 x 42 of the simulated 90 x 74 degrees (640 x 480 pixels; decision 0126).
RIGS = (Rig("narrow", 0.69, 0.51, stereo=False),)


def _window(pixels: int, share: float) -> tuple[int, int]:
    """Return the first pixel and the number of pixels of the middle part."""
    kept = max(1, round(pixels * share))
    return (pixels - kept) // 2, kept
