"""One question: where was this pair of pictures taken?"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, UInt8
from numpy.typing import NDArray

from service.geometry.camera import PinholeCamera
from service.geometry.rigid import Transform
from service.localization.prior import Prior

MOST_NEIGHBOURS = 50
#: Of calibration's strangers, every kind weighing alike (decision log).
FALSE_ACCEPT_RATE = 0.02
#: Least that may be asked for; no calibration could measure less.
LEAST_FALSE_ACCEPT_RATE = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Query:
    """Pictures that have been checked, and what is known beside them.

    Attributes:
        rgb: sRGB.
        depth_m: z, metres; 0 where nothing was measured.
        camera: rectified.
        down_camera: direction of gravity in the camera frame, if an IMU measured it.
        T_vehicle_camera: where the camera sits, if the vehicle's pose is wanted too.
        neighbours: k, the number of distinct places that vote and are answered.
        refine: register the picture on the map's cloud, where the map has one.
        ranked: answer at least this many places, beyond the k that vote; evaluation wants R@10.
        prior: what is known of the pose beforehand.
        baseline_m: of the stereo rig that measured the depth; its disparity offset is then estimated along with the pose, and its
            noise is that of matching at least.
        false_accept_rate: share of the queries taken outside the map that one can live with being accepted.
    """

    rgb: UInt8[NDArray[np.uint8], "H W 3"]
    depth_m: Float32[NDArray[np.float32], "h w"]
    camera: PinholeCamera
    down_camera: Float64[NDArray[np.float64], "3"] | None = None
    T_vehicle_camera: Transform | None = None
    neighbours: int = 5
    refine: bool = True
    ranked: int = 0
    prior: Prior | None = None
    baseline_m: float | None = None
    false_accept_rate: float = FALSE_ACCEPT_RATE

    @property
    def focal_baseline_px_m(self) -> float | None:
        """Horizontal focal length of the depth picture times the baseline; None where no stereo rig is known."""
        if self.baseline_m is None:
            return None
        return float(self.camera.fx * self.depth_m.shape[1] / self.camera.width * self.baseline_m)
