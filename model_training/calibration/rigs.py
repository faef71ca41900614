"""Cameras of other shapes than the simulated one, cut out of its pictures: confidence must hold for what robots carry.

A rig that sees less of the view grid shows less evidence at the same place. A calibration that has only met one shape takes every
other one for a stranger. Stereo rigs of other shapes are simulated as they are (``plans.PAIR_RIGS``).
"""

from dataclasses import dataclass, replace

import numpy as np

from service.localization.query import Query

#: Focal length times baseline of the simulated depth presets (``DepthModel``), pixels times metres.
FOCAL_BASELINE_PX_M = 80.0


@dataclass(frozen=True, slots=True)
class Rig:
    """A window in the middle of a picture.

    Attributes:
        name: of the kinds of queries.
        width: share of the picture's width;
        height: and of its height.
        stereo: the request says that depth is from a stereo rig, so it is registered with the noise of matching and a free offset.
    """

    name: str
    width: float
    height: float
    stereo: bool

    def __post_init__(self) -> None:
        """Refuse a window beyond the picture."""
        if not (0 < self.width <= 1 and 0 < self.height <= 1):
            raise ValueError(
                f"rig {self.name}: a window of {self.width:g} x {self.height:g} of the picture does not exist"
            )

    def seen(self, query: Query) -> Query:
        """The same query by this rig: both pictures, of one size, are cut, and the camera's principal point moves with them."""
        camera = query.camera
        left, width = _window(camera.width, self.width)
        top, height = _window(camera.height, self.height)
        cut = replace(camera, width=width, height=height, cx=camera.cx - left, cy=camera.cy - top)
        baseline_m = FOCAL_BASELINE_PX_M / camera.fx if self.stereo else query.baseline_m
        window = np.s_[top : top + height, left : left + width]
        rgb, depth_m = np.ascontiguousarray(query.rgb[window]), np.ascontiguousarray(query.depth_m[window])
        return replace(query, rgb=rgb, depth_m=depth_m, camera=cut, baseline_m=baseline_m)


#: Small RGB-D cameras see 69 x 42 of the simulated 90 x 74 degrees (640 x 480 pixels).
RIGS = (Rig("narrow", 0.69, 0.51, stereo=False),)


def _window(pixels: int, share: float) -> tuple[int, int]:
    """First pixel and number of pixels of the middle part."""
    kept = max(1, round(pixels * share))
    return (pixels - kept) // 2, kept
