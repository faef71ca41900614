"""Depth of a camera from the scan that was taken with its picture: a robot whose depth comes from its LiDAR.

Between the beams depth is interpolated on triangles of neighbouring points: the inverse of z is linear in the picture on any
plane, so walls and ground come out exactly. Triangles across an edge of depth, or across a gap in the scan, stay empty.
"""

import numpy as np
from jaxtyping import Float32, Float64
from numpy.typing import NDArray
from scipy.spatial import Delaunay, QhullError

from service.geometry.camera import PinholeCamera
from service.geometry.rigid import Transform, transform_points

NEAR_M = 0.5
#: Points of one surface: further apart in z than this they belong to two.
SURFACE_RATIO = 1.2
#: A point this much farther than the nearest around it is hidden from the camera, which does not stand where the LiDAR does.
HIDDEN_RATIO, HIDDEN_REACH_PX = 1.15, 5
#: A triangle with a longer side than so many times the usual one spans a gap.
GAP_RATIO = 3.0

Pixels = Float64[NDArray[np.float64], "N 2"]


def depth_from_scan(
    points: Float64[NDArray[np.float64], "N 3"], T_camera_lidar: Transform, camera: PinholeCamera
) -> Float32[NDArray[np.float32], "H W"]:
    """Depth of a scan in a rectified camera.

    Args:
        points: metres, LiDAR frame.
        T_camera_lidar: takes them to the optical frame.
        camera: without distortion.

    Returns:
        z in metres; 0 outside the scan, in its gaps and across edges of depth.
    """
    depth_m = np.zeros((camera.height, camera.width), np.float32)
    uv, z_m = visible_points(points, T_camera_lidar, camera)
    if len(z_m) < 4:
        return depth_m
    try:
        triangulation = Delaunay(uv)
    except QhullError:  # all on one line of the picture: there is no surface between them
        return depth_m
    corners = triangulation.simplices
    z = z_m[corners]
    sides = np.linalg.norm(uv[corners] - uv[np.roll(corners, 1, axis=1)], axis=2).max(axis=1)
    is_surface = (z.max(axis=1) <= SURFACE_RATIO * z.min(axis=1)) & (sides <= GAP_RATIO * np.median(sides))
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    pixels = np.stack([u.ravel(), v.ravel()], axis=1).astype(np.float64)
    triangle = triangulation.find_simplex(pixels)
    inside = (triangle >= 0) & is_surface[triangle]
    affine = triangulation.transform[triangle[inside]]
    first_two = np.einsum("nij,nj->ni", affine[:, :2], pixels[inside] - affine[:, 2])
    weights = np.c_[first_two, 1.0 - first_two.sum(axis=1)]
    inverse_z = (weights / z_m[corners[triangle[inside]]]).sum(axis=1)
    depth_m.ravel()[inside] = 1.0 / inverse_z
    return depth_m


def visible_points(
    points: Float64[NDArray[np.float64], "N 3"], T_camera_lidar: Transform, camera: PinholeCamera
) -> tuple[Pixels, NDArray[np.float64]]:
    """Pixels (u, v) and z of the points that the camera sees, one a pixel: the nearest."""
    seen = transform_points(T_camera_lidar, points)
    seen = seen[seen[:, 2] > NEAR_M]
    u = seen[:, 0] / seen[:, 2] * camera.fx + camera.cx
    v = seen[:, 1] / seen[:, 2] * camera.fy + camera.cy
    inside = (u >= 0) & (v >= 0) & (u <= camera.width - 1) & (v <= camera.height - 1)
    u, v, z = u[inside], v[inside], seen[inside, 2]
    order = np.argsort(z, kind="stable")
    cells = np.rint(v[order]).astype(np.int64) * camera.width + np.rint(u[order]).astype(np.int64)
    kept = order[np.unique(cells, return_index=True)[1]]
    u, v, z = u[kept], v[kept], z[kept]
    shown = z <= HIDDEN_RATIO * _nearest_around(u, v, z, camera)
    return np.stack([u[shown], v[shown]], axis=1), z[shown]


def _nearest_around(
    u: NDArray[np.float64], v: NDArray[np.float64], z: NDArray[np.float64], camera: PinholeCamera
) -> NDArray[np.float64]:
    """The smallest z near each point, beside it and above it: ground gets nearer further down, and hides nothing."""
    from scipy.ndimage import minimum_filter

    nearest = np.full((camera.height, camera.width), np.inf)
    rows, columns = np.rint(v).astype(np.intp), np.rint(u).astype(np.intp)
    np.minimum.at(nearest, (rows, columns), z)
    around: NDArray[np.float64] = minimum_filter(nearest, size=(HIDDEN_REACH_PX, 2 * HIDDEN_REACH_PX + 1))
    return around[rows, columns]
