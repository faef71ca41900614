"""What PointNetLK and ICP compare: a query's depth as points, and what the map would show from a pose.

Points are in the camera's frame (x right, y down, z forward), metres.
"""

import numpy as np
from numpy.typing import NDArray

from model_training.baselines.paper_data.pairs import Pairs
from model_training.baselines.regression.map_cloud import MapCloud
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import inverse, transform_points

REACH_M = 30.0  # of depth and of the map about a pose; PointNetLK's unit of length
HIDING_CELLS = 28  # of the picture, a side; some points of the map fall into each
HIDDEN_BEHIND = 1.3  # times the nearest z of its cell, and a metre: ground runs away within a cell
MAP_EVERY = 3  # of the map's points in view one is compared: some thousands are left, of which hundreds are drawn
STRIDE = 3  # of the depth picture's pixels
CELL_M = 0.4  # one point in so large a cell, so that what is near does not outweigh the rest
FEWEST = 50  # points of a cloud that is worth comparing

PointsF64 = NDArray[np.float64]  # (n, 3)


def depth_points(pairs: Pairs, row: int) -> PointsF64:
    """A query's depth in the camera's frame, thinned to an even density."""
    depth_m = np.asarray(pairs.depth_mm[row, ::STRIDE, ::STRIDE], np.float64) / 1000.0
    points = (pairs.camera.rays_of_pixels()[::STRIDE, ::STRIDE] * depth_m[..., None]).reshape(-1, 3)
    seen = points[(points[:, 2] > 0) & ((points**2).sum(axis=1) < REACH_M**2)]
    return thinned(seen)


def thinned(points: PointsF64) -> PointsF64:
    """The first point in each cell."""
    cell = np.floor(points / CELL_M).astype(np.int64)
    _, first = np.unique(((cell[:, 0] << 20) + cell[:, 1] << 20) + cell[:, 2], return_index=True)
    kept: PointsF64 = points[np.sort(first)]
    return kept


def map_points_in_view(cloud: MapCloud, T_map_camera: NDArray[np.float64], camera: PinholeCamera) -> PointsF64:
    """What the map shows from a pose: its points within the camera's reach and field of view that nothing stands before."""
    points = transform_points(inverse(T_map_camera), cloud.around(T_map_camera[:3, 3], REACH_M, every=MAP_EVERY))
    ahead = points[points[:, 2] > 0.5]
    u = np.floor((camera.fx * ahead[:, 0] / ahead[:, 2] + camera.cx + 0.5) / (camera.width / HIDING_CELLS)).astype(
        np.int64
    )
    v = np.floor((camera.fy * ahead[:, 1] / ahead[:, 2] + camera.cy + 0.5) / (camera.height / HIDING_CELLS)).astype(
        np.int64
    )
    inside = (u >= 0) & (u < HIDING_CELLS) & (v >= 0) & (v < HIDING_CELLS)
    ahead, cell = ahead[inside], (v * HIDING_CELLS + u)[inside]
    nearest_m = np.full(HIDING_CELLS**2, np.inf)
    np.minimum.at(nearest_m, cell, ahead[:, 2])
    seen: PointsF64 = ahead[ahead[:, 2] <= HIDDEN_BEHIND * nearest_m[cell] + 1.0]
    return seen


def sampled(points: PointsF64, count: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """``count`` of the points (n > 0), each at most once where there are enough; in PointNetLK's unit."""
    rows = rng.choice(len(points), count, replace=len(points) < count)
    return (points[rows] / REACH_M).astype(np.float32)
