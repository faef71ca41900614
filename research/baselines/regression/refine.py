"""Registration of a query whose pose a network has estimated: PointNetLK, then ICP, against the map cloud.

Each step keeps the previous estimate if it cannot register. The reasons are too few points, no convergence, too few
inliers, fewer points on the map than before, or a motion beyond the limit. The reach of ICP matters little: (8, 2.5, 1)
and (15, 5, 1) m found no more of poses that were 3, 8 and 15 m off (2026-11-22).
"""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from research.baselines.regression.clouds import FEWEST, REACH_M, map_points_in_view, sampled
from research.baselines.regression.lucas_kanade import aligned
from research.baselines.regression.map_cloud import MapCloud, small_gicp_package
from research.baselines.regression.pointnet import PointNet
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import quaternion_xyzw_from, rotation_from_quaternion_xyzw, transform_points

LK_POINTS, LK_ITERATIONS = 1024, 20
LK_MOST_M = 15.0
NEAR_M = 1.0
#: Point-to-plane: the map's points are voxel means. They are not the points that the camera measures, but lie on the
#: same surfaces.
ICP_KIND = "PLANE_ICP"
#: Largest distance of a correspondence, metres: coarse, then fine.
ICP_REACHES_M = (4.0, 1.0)
ICP_ITERATIONS = 40
#: Smallest share of the points that must be inliers within the fine reach.
ICP_LEAST_INLIERS = 0.6
ICP_MOST_M = 10.0

PointsF64 = NDArray[np.float64]  # (n, 3)
Transform = NDArray[np.float64]  # (4, 4)


@dataclass(frozen=True, slots=True, eq=False)
class Refined:
    """Result of a registration.

    Attributes:
        T_map_camera: pose (4, 4).
        registered: whether the pose is the registration's own; otherwise it is the given one.
    """

    T_map_camera: Transform
    registered: bool


def by_pointnet_lk(
    net: PointNet, cloud: MapCloud, points_camera: PointsF64, T_map_camera: Transform, camera: PinholeCamera
) -> Refined:
    """Align a query's points by PointNetLK to the map points visible from its estimated pose.

    Args:
        net: trained PointNet.
        cloud: map cloud.
        points_camera: points of the query (n, 3), metres, camera frame.
        T_map_camera: estimated pose (4, 4).
        camera: camera of the query.

    Raises:
        ExtraMissingError: small_gicp is not installed.
    """
    shown = map_points_in_view(cloud, T_map_camera, camera)
    if min(len(shown), len(points_camera)) < FEWEST:
        return Refined(T_map_camera, registered=False)
    rng = np.random.default_rng(3)
    template, source = (torch.from_numpy(sampled(each, LK_POINTS, rng))[None] for each in (shown, points_camera))
    with torch.inference_mode():
        found = aligned(net, template, source, iterations=LK_ITERATIONS)
        nearer = bool(found.residual.norm() < found.first_residual.norm())  # False for NaN
    T_estimate_camera = found.T_template_source[0].double().numpy().copy()
    T_estimate_camera[:3, 3] *= REACH_M
    if not nearer or not np.linalg.norm(T_estimate_camera[:3, 3]) <= LK_MOST_M:
        return Refined(T_map_camera, registered=False)
    T_found = _rigid(T_map_camera @ T_estimate_camera)
    if share_on_map(cloud, points_camera, T_found) < share_on_map(cloud, points_camera, T_map_camera):
        return Refined(T_map_camera, registered=False)
    return Refined(T_found, registered=True)


def share_on_map(cloud: MapCloud, points_camera: PointsF64, T_map_camera: Transform) -> float:
    """Return the share of a query's points with a map point within a metre.

    Args:
        cloud: map cloud.
        points_camera: points of the query (n, 3), metres, camera frame.
        T_map_camera: pose (4, 4).
    """
    _, tree = cloud.target
    _, squares = tree.batch_nearest_neighbor_search(transform_points(T_map_camera, points_camera), num_threads=1)
    return float(np.mean(np.asarray(squares) < NEAR_M**2))


def by_icp(cloud: MapCloud, points_camera: PointsF64, T_map_camera: Transform) -> Refined:
    """Register a query's points to the map cloud by ICP from an estimated pose.

    Args:
        cloud: map cloud.
        points_camera: points of the query (n, 3), metres, camera frame.
        T_map_camera: estimated pose (4, 4).

    Raises:
        ExtraMissingError: small_gicp is not installed.
    """
    package = small_gicp_package()
    if min(len(points_camera), len(cloud.points_map)) < FEWEST:
        return Refined(T_map_camera, registered=False)
    (target, tree), source, T = cloud.target, package.PointCloud(points_camera), T_map_camera
    for reach_m in ICP_REACHES_M:
        found = package.align(
            target,
            source,
            tree,
            T,
            registration_type=ICP_KIND,
            max_correspondence_distance=reach_m,
            num_threads=1,
            max_iterations=ICP_ITERATIONS,
        )
        T = np.asarray(found.T_target_source, np.float64)
        if not np.isfinite(T).all():
            return Refined(T_map_camera, registered=False)
    moved_m = float(np.linalg.norm(T[:3, 3] - T_map_camera[:3, 3]))
    enough = found.num_inliers >= ICP_LEAST_INLIERS * len(points_camera)
    if not found.converged or not enough or moved_m > ICP_MOST_M:
        return Refined(T_map_camera, registered=False)
    return Refined(_rigid(T), registered=True)


def _rigid(T: Transform) -> Transform:
    """Return the transform with an exact rotation; that of single precision is not exact."""
    exact = T.copy()
    exact[:3, :3] = rotation_from_quaternion_xyzw(quaternion_xyzw_from(T[:3, :3]))
    return exact
