"""Convert CARLA's left-handed frame (x forward, y right, z up; degrees) and its 24-bit depth to our conventions."""

import numpy as np
from jaxtyping import Float32, UInt8
from numpy.typing import NDArray

from service.geometry.rigid import R_BODY_OPTICAL, Transform, transform_from

#: Mirror between the left-handed and the right-handed frame; it is its own inverse.
_MIRROR = np.diag([1.0, -1.0, 1.0])
#: Greatest depth that CARLA encodes, metres.
DEPTH_REACH_M = 1000.0


def T_from_carla(x: float, y: float, z: float, roll_deg: float, pitch_deg: float, yaw_deg: float) -> Transform:
    """Convert a ``carla.Transform`` to a right-handed matrix of a body: x forward, y left, z up.

    Unreal rotates by yaw about z, then pitch, then roll. Pitch up and roll to the right are positive
    (the matrix of ``carla.Transform.get_matrix``).

    Args:
        x: forward, metres.
        y: to the right, metres.
        z: up, metres.
        roll_deg: degrees.
        pitch_deg: degrees.
        yaw_deg: degrees.

    Returns:
        Transform (4, 4).
    """
    roll, pitch, yaw = np.deg2rad([roll_deg, pitch_deg, yaw_deg])
    cr, sr, cp, sp, cy, sy = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch), np.cos(yaw), np.sin(yaw)
    R = np.array(
        [
            [cp * cy, cy * sp * sr - sy * cr, -cy * sp * cr - sy * sr],
            [cp * sy, sy * sp * sr + cy * cr, -sy * sp * cr + cy * sr],
            [sp, -cp * sr, cp * cr],
        ]
    )
    return transform_from(_MIRROR @ R @ _MIRROR, _MIRROR @ np.array([x, y, z]))


def optical(T_vehicle_body: Transform) -> Transform:
    """Return the pose of a camera's optical frame. CARLA mounts a camera as a body that looks along x.

    Args:
        T_vehicle_body: pose of that body (4, 4).
    """
    T: Transform = T_vehicle_body @ transform_from(R_BODY_OPTICAL, np.zeros(3))
    return T


def points_from_carla(points: Float32[NDArray[np.float32], "N 4"]) -> Float32[NDArray[np.float32], "N 4"]:
    """Convert points of CARLA's LiDAR to our right-handed frame.

    Args:
        points: x y z (m) and intensity, in the LiDAR's left-handed frame.
    """
    return np.ascontiguousarray(points * np.array([1, -1, 1, 1], np.float32))


def depth_from_carla(bgr: UInt8[NDArray[np.uint8], "H W 3"]) -> Float32[NDArray[np.float32], "H W"]:
    """Decode CARLA's depth image: 24 bits for 0 to 1000 m, the lowest byte in red.

    Args:
        bgr: the image as OpenCV decodes it.

    Returns:
        z, metres; 0 from 990 m on, where the camera sees nothing.
    """
    steps = bgr.astype(np.float64) @ np.array([65536.0, 256.0, 1.0])
    metres = DEPTH_REACH_M * steps / (2**24 - 1)
    return np.where(metres < 0.99 * DEPTH_REACH_M, metres, 0.0).astype(np.float32)
