"""Motion de-skew: the points of one turn of the LiDAR as if all were measured at the scan's own moment."""

import numpy as np
from jaxtyping import Float32, Float64
from numpy.typing import NDArray

from model_training.importing.recording import RecordedScan
from model_training.importing.trajectory import Trajectory
from service.geometry.rigid import Transform, inverse

#: Points this close in time share a pose: at 20 m/s and 90 deg/s that is 2 cm and 0.1 degrees.
STEP_S = 0.001
#: No turn takes longer: times further from the scan's stamp are those of another clock.
MOST_OFFSET_S = 1.0


def times_fit(scan: RecordedScan) -> bool:
    """Whether the times of a scan's points are of the clock of its stamp, so that they can be used; True where there are none."""
    return scan.offsets_s is None or bool((np.abs(scan.offsets_s) <= MOST_OFFSET_S).all())  # False for NaN too


def deskewed(
    scan: RecordedScan, trajectory: Trajectory, T_vehicle_lidar: Transform
) -> Float32[NDArray[np.float32], "N 4"]:
    """Points of a scan, each moved by how the vehicle moved between it and the scan's moment.

    Args:
        scan: with the times of its points; without them its points come back as they are.
        trajectory: T_map_vehicle, at least as fine in time as the vehicle's changes of speed.
        T_vehicle_lidar: where the LiDAR stands.
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
