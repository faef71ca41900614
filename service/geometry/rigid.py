"""Rigid transforms as 4x4 matrices in float64. ``T_map_camera`` maps points from the camera frame to the map frame."""

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

Transform = Float64[NDArray[np.float64], "4 4"]
Rotation = Float64[NDArray[np.float64], "3 3"]
Points = Float64[NDArray[np.float64], "N 3"]

#: Rotation from the optical frame (x right, y down, z forward) to the body frame (x forward, y left, z up), REP-103.
R_BODY_OPTICAL: NDArray[np.float64] = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
#: Two positions are the same if they differ by no more than this, metres: rounding of files and of arithmetic.
SAME_M = 1e-6


def transform_from(rotation: Rotation, translation_m: Float64[NDArray[np.float64], "3"]) -> Transform:
    """Combine a rotation and a translation into one 4x4 matrix.

    Args:
        rotation: R_a_b.
        translation_m: origin of frame b in frame a, metres.
    """
    T = np.eye(4)
    T[:3, :3] = rotation
    T[:3, 3] = translation_m
    return T


def transform_points(T_a_b: Transform, points_b: Points) -> Points:
    """Transform points from frame b to frame a.

    Args:
        T_a_b: transform from frame b to frame a, translation in metres.
        points_b: points in frame b, metres.
    """
    points_a = points_b @ T_a_b[:3, :3].T
    for axis in range(3):  # NumPy takes three times as long for rows of three
        points_a[..., axis] += T_a_b[axis, 3]
    return points_a


def inverse(T_a_b: Transform) -> Transform:
    """Return T_b_a, computed from the transposed rotation.

    Args:
        T_a_b: transform from frame b to frame a.
    """
    R = T_a_b[:3, :3]
    return transform_from(R.T.copy(), -R.T @ T_a_b[:3, 3])


def nearest_rigid(T: Transform) -> Transform:
    """Project the rotation of a transform onto SO(3) by SVD. Products of many rotations drift away from it.

    Args:
        T: transform (4, 4), metres.
    """
    u, _, vt = np.linalg.svd(T[:3, :3])
    found = T.copy()
    found[:3, :3] = u @ vt
    return found


def rotation_x(angle_rad: float) -> Rotation:
    """Return the rotation about the x axis (paper, eq. 7).

    Args:
        angle_rad: angle by the right-hand rule, radians.
    """
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def rotation_y(angle_rad: float) -> Rotation:
    """Return the rotation about the y axis (paper, eq. 8).

    Args:
        angle_rad: angle by the right-hand rule, radians.
    """
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def rotation_z(angle_rad: float) -> Rotation:
    """Return the rotation about the z axis (paper, eq. 6).

    Args:
        angle_rad: angle by the right-hand rule, radians.
    """
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def rotation_taking(a: Float64[NDArray[np.float64], "3"], b: Float64[NDArray[np.float64], "3"]) -> Rotation:
    """Return the smallest rotation that turns unit vector a into unit vector b (Rodrigues).

    Opposite vectors have no unique smallest rotation. Then the function turns by 180 degrees about a perpendicular axis.

    Args:
        a: unit vector before the rotation.
        b: unit vector after the rotation, in the same frame.
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
    """Return the unit quaternion x, y, z, w with w >= 0 (Shepperd's method, the largest component first).

    Args:
        rotation: rotation matrix.
    """
    m = rotation
    squares = np.array(
        [
            1 + m[0, 0] - m[1, 1] - m[2, 2],
            1 - m[0, 0] + m[1, 1] - m[2, 2],
            1 - m[0, 0] - m[1, 1] + m[2, 2],
            1 + m[0, 0] + m[1, 1] + m[2, 2],
        ]
    )
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
    """Return the rotation matrix of a quaternion.

    Args:
        q_xyzw: quaternion x, y, z, w. Any length except zero.
    """
    x, y, z, w = q_xyzw / np.linalg.norm(q_xyzw)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def wrap_angle(angle_rad: float) -> float:
    """Return the same angle in [-pi, pi).

    Args:
        angle_rad: any angle, radians.
    """
    return float((angle_rad + np.pi) % (2 * np.pi) - np.pi)


def heading_of_camera(T_map_camera: Transform) -> float:
    """Return the heading of the optical axis, radians, counter-clockwise from map x.

    Args:
        T_map_camera: camera pose. The optical axis is z.
    """
    return float(np.arctan2(T_map_camera[1, 2], T_map_camera[0, 2]))


def heading_of_body(T_map_body: Transform) -> float:
    """Return the heading of the x axis of a vehicle or LiDAR, radians, counter-clockwise from map x.

    Args:
        T_map_body: pose of the vehicle or LiDAR. The forward axis is x.
    """
    return float(np.arctan2(T_map_body[1, 0], T_map_body[0, 0]))
