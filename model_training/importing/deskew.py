"""Motion de-skew: move all points of one turn of the LiDAR to the time of the scan."""

import numpy as np
from jaxtyping import Float32, Float64
from numpy.typing import NDArray

from model_training.importing.recording import RecordedScan
from model_training.importing.trajectory import Trajectory
from service.geometry.rigid import Transform, inverse

#: Points within this time share a pose, seconds. At 20 m/s and 90 deg/s the error is 2 cm and 0.1 degrees.
STEP_S = 0.001
#: Greatest time between a point and its scan, seconds. No turn takes longer, so larger times come from another clock.
MOST_OFFSET_S = 1.0


def times_fit(scan: RecordedScan) -> bool:
    """Check whether the times of a scan's points come from the clock of its stamp; True without such times.

    Args:
        scan: one turn of the LiDAR.
    """
    return scan.offsets_s is None or bool((np.abs(scan.offsets_s) <= MOST_OFFSET_S).all())  # False for NaN too


def deskewed(
    scan: RecordedScan, trajectory: Trajectory, T_vehicle_lidar: Transform
) -> Float32[NDArray[np.float32], "N 4"]:
    """Return the points of a scan as if all were measured at its stamp.

    Args:
        scan: one turn of the LiDAR. Without times its points are returned unchanged.
        trajectory: T_map_vehicle, fine enough in time to follow the vehicle's changes of speed.
        T_vehicle_lidar: mounting of the LiDAR (4, 4).

    Returns:
        x y z (m) and intensity (N, 4), in the LiDAR frame at the scan's stamp.
    """
    if scan.offsets_s is None or not len(scan.points):
        return scan.points
    steps, step_of_point = np.unique(np.round(scan.offsets_s / STEP_S).astype(np.int64), return_inverse=True)
    T_map_vehicle = trajectory.between(np.r_[scan.stamp_s, scan.stamp_s + steps * STEP_S])
    T_map_lidar = T_map_vehicle @ T_vehicle_lidar
    T_now_then: Float64[NDArray[np.float64], "M 4 4"] = inverse(T_map_lidar[0]) @ T_map_lidar[1:]
    T = T_now_then[step_of_point]
    moved = scan.points.copy()
    moved[:, :3] = np.einsum("nij,nj->ni", T[:, :3, :3], scan.points[:, :3].astype(np.float64)) + T[:, :3, 3]
    return moved
