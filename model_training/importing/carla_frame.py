"""From CARLA's left-handed world (x ahead, y right, z up; degrees) to ours, and its depth out of 24 bits."""

import numpy as np
from jaxtyping import Float32, UInt8
from numpy.typing import NDArray

from service.geometry.rigid import R_BODY_OPTICAL, Transform, transform_from

#: The mirror that takes one handedness to the other; it is its own inverse.
_MIRROR = np.diag([1.0, -1.0, 1.0])
DEPTH_REACH_M = 1000.0


def T_from_carla(x: float, y: float, z: float, roll_deg: float, pitch_deg: float, yaw_deg: float) -> Transform:
    """A ``carla.Transform`` (metres, degrees) as a right-handed matrix of a body: x ahead, y left, z up.

    Unreal's rotation turns by yaw about z, then pitch, then roll, with pitch up and roll to the right positive
    (the matrix of ``carla.Transform.get_matrix``).
    """
    roll, pitch, yaw = np.deg2rad([roll_deg, pitch_deg, yaw_deg])
    cr, sr, cp, sp, cy, sy = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch), np.cos(yaw), np.sin(yaw)
    R = np.array([
        [cp * cy, cy * sp * sr - sy * cr, -cy * sp * cr - sy * sr],
        [cp * sy, sy * sp * sr + cy * cr, -sy * sp * cr + cy * sr],
        [sp, -cp * sr, cp * cr],
    ])  # fmt: skip
    return transform_from(_MIRROR @ R @ _MIRROR, _MIRROR @ np.array([x, y, z]))


def optical(T_vehicle_body: Transform) -> Transform:
    """The optical frame of a camera that CARLA mounts as a body that looks along x."""
    T: Transform = T_vehicle_body @ transform_from(R_BODY_OPTICAL, np.zeros(3))
    return T


def points_from_carla(points: Float32[NDArray[np.float32], "N 4"]) -> Float32[NDArray[np.float32], "N 4"]:
    """Points of CARLA's LiDAR (its own left-handed frame) in ours."""
    return np.ascontiguousarray(points * np.array([1, -1, 1, 1], np.float32))


def depth_from_carla(bgr: UInt8[NDArray[np.uint8], "H W 3"]) -> Float32[NDArray[np.float32], "H W"]:
    """Depth (z, metres) of CARLA's depth picture: 24 bits, red lowest, of a kilometre; 0 where it sees nothing."""
    steps = bgr.astype(np.float64) @ np.array([65536.0, 256.0, 1.0])
    metres = DEPTH_REACH_M * steps / (2**24 - 1)
    return np.where(metres < 0.99 * DEPTH_REACH_M, metres, 0.0).astype(np.float32)
