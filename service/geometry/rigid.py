"""Rigid transforms: 4x4 matrices in float64, frames in their names (``T_map_camera`` takes camera to map)."""

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

Transform = Float64[NDArray[np.float64], "4 4"]
Rotation = Float64[NDArray[np.float64], "3 3"]
Points = Float64[NDArray[np.float64], "N 3"]

#: Optical frame (x right, y down, z forward) into body frame (x forward, y left, z up), REP-103.
R_BODY_OPTICAL: NDArray[np.float64] = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def transform_from(rotation: Rotation, translation_m: Float64[NDArray[np.float64], "3"]) -> Transform:
    """Put a rotation and a translation (metres) into one 4x4 matrix."""
    T = np.eye(4)
    T[:3, :3] = rotation
    T[:3, 3] = translation_m
    return T


def transform_points(T_a_b: Transform, points_b: Points) -> Points:
    """Take points (metres) from frame b to frame a."""
    return points_b @ T_a_b[:3, :3].T + T_a_b[:3, 3]


def inverse(T_a_b: Transform) -> Transform:
    """T_b_a, without a general matrix inverse."""
    R = T_a_b[:3, :3]
    return transform_from(R.T.copy(), -R.T @ T_a_b[:3, 3])


def rotation_x(angle_rad: float) -> Rotation:
    """Rotation about x (paper, eq. 7)."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def rotation_y(angle_rad: float) -> Rotation:
    """Rotation about y (paper, eq. 8)."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def rotation_z(angle_rad: float) -> Rotation:
    """Rotation about z (paper, eq. 6)."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def rotation_taking(a: Float64[NDArray[np.float64], "3"], b: Float64[NDArray[np.float64], "3"]) -> Rotation:
    """The smallest rotation that turns unit vector a into unit vector b (Rodrigues).

    Opposite vectors have no smallest rotation; any perpendicular axis is taken.
    """
    axis = np.cross(a, b)
    cosine = float(a @ b)
    if cosine < -1.0 + 1e-12:
        helper = np.eye(3)[int(np.argmin(np.abs(a)))]
        axis = np.cross(a, helper)
        axis /= np.linalg.norm(axis)
        return np.asarray(2.0 * np.outer(axis, axis) - np.eye(3))
    K = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    rotation: Rotation = np.eye(3) + K + K @ K / (1.0 + cosine)
    return rotation


def quaternion_xyzw_from(rotation: Rotation) -> Float64[NDArray[np.float64], "4"]:
    """Unit quaternion x, y, z, w with w >= 0 (Shepperd's method, the largest component first)."""
    m = rotation
    squares = np.array([1 + m[0, 0] - m[1, 1] - m[2, 2], 1 - m[0, 0] + m[1, 1] - m[2, 2],
                        1 - m[0, 0] - m[1, 1] + m[2, 2], 1 + m[0, 0] + m[1, 1] + m[2, 2]])  # fmt: skip
    k = int(np.argmax(squares))
    s = 2.0 * np.sqrt(squares[k])
    if k == 3:
        q = np.array([m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], s * s / 4]) / s
    elif k == 0:
        q = np.array([s * s / 4, m[0, 1] + m[1, 0], m[0, 2] + m[2, 0], m[2, 1] - m[1, 2]]) / s
    elif k == 1:
        q = np.array([m[0, 1] + m[1, 0], s * s / 4, m[1, 2] + m[2, 1], m[0, 2] - m[2, 0]]) / s
    else:
        q = np.array([m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], s * s / 4, m[1, 0] - m[0, 1]]) / s
    q = q / np.linalg.norm(q)
    unit: Float64[NDArray[np.float64], 4] = -q if q[3] < 0 else q
    return unit


def rotation_from_quaternion_xyzw(q_xyzw: Float64[NDArray[np.float64], "4"]) -> Rotation:
    """Rotation matrix of a quaternion x, y, z, w of any length but zero."""
    x, y, z, w = q_xyzw / np.linalg.norm(q_xyzw)
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


def wrap_angle(angle_rad: float) -> float:
    """The same angle in [-pi, pi)."""
    return float((angle_rad + np.pi) % (2 * np.pi) - np.pi)


def heading_of_camera(T_map_camera: Transform) -> float:
    """Heading of the optical axis, radians, counter-clockwise from map x."""
    return float(np.arctan2(T_map_camera[1, 2], T_map_camera[0, 2]))


def heading_of_body(T_map_body: Transform) -> float:
    """Heading of the x axis of a vehicle or LiDAR, radians, counter-clockwise from map x."""
    return float(np.arctan2(T_map_body[1, 0], T_map_body[0, 0]))
