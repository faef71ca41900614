"""The query: one RGB image, one depth image, their camera and the options."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, UInt8
from numpy.typing import NDArray

from service.geometry.camera import PinholeCamera
from service.geometry.rigid import Transform
from service.localization.prior import Prior

#: Default and upper limit of the option ``neighbours``.
NEIGHBOURS, MOST_NEIGHBOURS = 5, 50
#: Default share of the out-of-map queries in calibration that may be accepted. All kinds have equal weight (decisions 0039, 0084).
FALSE_ACCEPT_RATE = 0.02
#: Lower limit of the option ``false_accept_rate``. No calibration could measure a lower rate.
LEAST_FALSE_ACCEPT_RATE = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Query:
    """A checked image pair and its options.

    Attributes:
        rgb: colour image, sRGB.
        depth_m: depth image, z in metres; 0 where nothing was measured.
        camera: intrinsics of the rectified camera.
        down_camera: direction of gravity in the camera frame, from an IMU; None if unknown.
        T_vehicle_camera: pose of the camera on the vehicle; None if the vehicle pose is not wanted.
        neighbours: k, the number of distinct places that vote and that the answer lists.
        refine: whether to register the images on the map cloud, if the map has one.
        ranked: smallest number of places in the answer, beyond the k that vote. Evaluation needs more places for R@10.
        prior: prior of the camera pose; None if nothing is known.
        baseline_m: baseline of the stereo rig that measured the depth; None if no rig is known. With a baseline, registration also
            estimates the disparity offset, and the depth noise is at least that of stereo matching.
        false_accept_rate: largest tolerated share of out-of-map queries that become LOCALIZED, 0 to 1.
    """

    rgb: UInt8[NDArray[np.uint8], "H W 3"]
    depth_m: Float32[NDArray[np.float32], "h w"]
    camera: PinholeCamera
    down_camera: Float64[NDArray[np.float64], "3"] | None = None
    T_vehicle_camera: Transform | None = None
    neighbours: int = NEIGHBOURS
    refine: bool = True
    ranked: int = 0
    prior: Prior | None = None
    baseline_m: float | None = None
    false_accept_rate: float = FALSE_ACCEPT_RATE

    @property
    def focal_baseline_px_m(self) -> float | None:
        """Horizontal focal length of the depth image (px) times the baseline (m); None if no stereo rig is known."""
        if self.baseline_m is None:
            return None
        return float(self.camera.fx * self.depth_m.shape[1] / self.camera.width * self.baseline_m)
