"""Turn a query of the simulated camera into that of another rig: a smaller field of view, or depth from a spinning LiDAR.

A camera that covers less of the view grid has other confidence features at the same place. A calibration with a single field of view
classifies queries with another field of view as out-of-map (decision 0126). Most families are simulated directly (``families.FAMILIES``).
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from service.geometry.camera import PinholeCamera
from service.registration.points import FOCAL_BASELINE_PX_M
from service.retrieval.query import Query


@dataclass(frozen=True, slots=True)
class Rig:
    """A camera that sees a window in the middle of the simulated image, or has depth on the beams of a LiDAR only.

    Attributes:
        name: name of the rig in its kinds of queries.
        width: width of the window, as a share of the image's width.
        height: height of the window, as a share of the image's height.
        stereo: the query states a stereo baseline. Registration then uses the noise of stereo matching and a free disparity offset.
        beams_deg: elevations of the beams that measure depth, degrees; empty for a depth image.
        cameras: number of successive frames that are one query, because as many cameras took them together.

    Raises:
        ValueError: the window is empty or exceeds the image.
    """

    name: str
    width: float = 1.0
    height: float = 1.0
    stereo: bool = False
    beams_deg: tuple[float, ...] = ()
    cameras: int = 1

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
        if self.beams_deg:
            depth_m = np.where(_on_beams(cut, self.beams_deg), depth_m, np.float32(0))
        return replace(query, rgb=rgb, depth_m=depth_m, camera=cut, baseline_m=baseline_m)


#: The rigs of the calibration. Small RGB-D cameras see 69 x 42 of the simulated 90 x 74 degrees (640 x 480 pixels; decision 0126).
RIGS = (Rig("narrow", 0.69, 0.51),)


def _on_beams(camera: PinholeCamera, beams_deg: tuple[float, ...]) -> NDArray[np.bool_]:
    """Return the pixels (H, W) within half a pixel of a beam, for a LiDAR at the camera's place that is as level as the camera."""
    rays = camera.rays_of_pixels()
    elevation = np.arctan2(-rays[..., 1], np.hypot(rays[..., 0], rays[..., 2]))
    away = np.full(elevation.shape, np.inf)
    for beam in np.deg2rad(beams_deg):
        away = np.minimum(away, np.abs(elevation - beam))
    return np.asarray(away < 0.5 / camera.fy)


def _window(pixels: int, share: float) -> tuple[int, int]:
    """Return the first pixel and the number of pixels of the middle part."""
    kept = max(1, round(pixels * share))
    return (pixels - kept) // 2, kept
