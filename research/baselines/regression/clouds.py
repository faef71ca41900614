"""Clouds for PointNetLK and ICP: a query's depth as points, and the map points visible from a pose.

Points are in the camera's frame (x right, y down, z forward), metres.
"""

import numpy as np
from numpy.typing import NDArray

from research.baselines.paper_data.pairs import Pairs
from research.baselines.regression.map_cloud import MapCloud
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import inverse, transform_points

#: Largest distance of depth and of map points from a pose, metres. It is also PointNetLK's unit of length.
REACH_M = 30.0
#: Cells per side of the image for the visibility test. Several map points fall into each cell.
HIDING_CELLS = 28
#: A point is hidden beyond this factor times the nearest z of its cell, plus a metre. The factor allows for ground that
#: recedes within a cell.
HIDDEN_BEHIND = 1.3
#: Every n-th map point in view is used. Some thousands remain, of which hundreds are drawn.
MAP_EVERY = 3
#: Every n-th pixel of the depth image is used.
STRIDE = 3
#: Cell size with one point per cell, metres, so that near surfaces do not outweigh the rest.
CELL_M = 0.4
#: Fewest points of a cloud for a comparison.
FEWEST = 50

PointsF64 = NDArray[np.float64]  # (n, 3)


def depth_points(pairs: Pairs, row: int) -> PointsF64:
    """Return a query's depth as points (n, 3) in the camera's frame, thinned to an even density.

    Args:
        pairs: RGB-D pairs.
        row: row of the query.
    """
    depth_m = np.asarray(pairs.depth_mm[row, ::STRIDE, ::STRIDE], np.float64) / 1000.0
    points = (pairs.camera.rays_of_pixels()[::STRIDE, ::STRIDE] * depth_m[..., None]).reshape(-1, 3)
    seen = points[(points[:, 2] > 0) & ((points**2).sum(axis=1) < REACH_M**2)]
    return thinned(seen)


def thinned(points: PointsF64) -> PointsF64:
    """Return the first point in each cell (m, 3).

    Args:
        points: points (n, 3), metres.
    """
    cell = np.floor(points / CELL_M).astype(np.int64)
    _, first = np.unique(((cell[:, 0] << 20) + cell[:, 1] << 20) + cell[:, 2], return_index=True)
    kept: PointsF64 = points[np.sort(first)]
    return kept


def map_points_in_view(cloud: MapCloud, T_map_camera: NDArray[np.float64], camera: PinholeCamera) -> PointsF64:
    """Return the map points (n, 3) in the camera's frame that are in reach, in the field of view and not hidden.

    Args:
        cloud: map cloud.
        T_map_camera: pose (4, 4).
        camera: camera of the view.
    """
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
    """Sample ``count`` points (count, 3) in PointNetLK's unit, without repetition if there are enough.

    Args:
        points: points (n, 3), metres; n > 0.
        count: number of points.
        rng: source of randomness.
    """
    rows = rng.choice(len(points), count, replace=len(points) < count)
    return (points[rows] / REACH_M).astype(np.float32)
