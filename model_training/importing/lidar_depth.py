"""Make the depth image of a camera from the scan recorded at the same time, for a robot whose depth comes from its LiDAR.

Between the beams depth is interpolated on triangles of neighbouring points. On any plane the inverse of z is linear in
the image, so walls and ground are exact. Triangles across a depth edge or a gap in the scan stay empty (decision 0055).
"""

import numpy as np
from jaxtyping import Float32, Float64
from numpy.typing import NDArray
from scipy.spatial import Delaunay, QhullError

from service.geometry.camera import PinholeCamera
from service.geometry.rigid import Transform, transform_points

#: Least z of a point that is used, metres.
NEAR_M = 0.5
#: Greatest ratio of z between the corners of a triangle on one surface.
SURFACE_RATIO = 1.2
#: A point is hidden if its z exceeds the least z around it by this ratio; and size of that neighbourhood, pixels.
#: Camera and LiDAR stand at different positions, so the camera does not see all points.
HIDDEN_RATIO, HIDDEN_REACH_PX = 1.15, 5
#: A triangle spans a gap if its longest side exceeds the median longest side by this ratio.
GAP_RATIO = 3.0

Pixels = Float64[NDArray[np.float64], "N 2"]


def depth_from_scan(
    points: Float64[NDArray[np.float64], "N 3"], T_camera_lidar: Transform, camera: PinholeCamera
) -> Float32[NDArray[np.float32], "H W"]:
    """Interpolate the depth of a scan in a rectified camera.

    Args:
        points: metres, LiDAR frame.
        T_camera_lidar: maps points from the LiDAR frame to the optical frame (4, 4).
        camera: without distortion.

    Returns:
        z, metres; 0 outside the scan, in its gaps and across depth edges.
    """
    depth_m = np.zeros((camera.height, camera.width), np.float32)
    uv, z_m = visible_points(points, T_camera_lidar, camera)
    if len(z_m) < 4:
        return depth_m
    try:
        triangulation = Delaunay(uv)
    except QhullError:  # all points lie on one line of the image, so there is no surface between them
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
    """Project the points that the camera sees: the nearest point per pixel, without hidden ones.

    Args:
        points: metres, LiDAR frame.
        T_camera_lidar: maps points from the LiDAR frame to the optical frame (4, 4).
        camera: without distortion.

    Returns:
        Pixel coordinates u, v (N, 2), and z (N,), metres.
    """
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
    """The least z in a window around each point that is wider than high.

    Ground is nearer further down in the image but hides nothing, so the window is low.
    """
    from scipy.ndimage import minimum_filter

    nearest = np.full((camera.height, camera.width), np.inf)
    rows, columns = np.rint(v).astype(np.intp), np.rint(u).astype(np.intp)
    np.minimum.at(nearest, (rows, columns), z)
    around: NDArray[np.float64] = minimum_filter(nearest, size=(HIDDEN_REACH_PX, 2 * HIDDEN_REACH_PX + 1))
    return around[rows, columns]
