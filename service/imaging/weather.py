"""Remove rain and snow from a LiDAR scan by the principal components of each point's neighbourhood.

Reference 19 of the paper cleans point clouds by PCA and gives no details. The rule that identifies noise is ours (2026-11).

- Drops and flakes are isolated in the air near the sensor. Few of the beams in their direction return from them. These returns
  lie on no line and no plane.
- Structure returns all beams of its direction. Or it forms at least a plane or a line (a pole, a ring of the scan on the ground).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, Shaped
from numpy.typing import NDArray

Points = Float32[NDArray[np.float32], "N 3"]

_AROUND = np.array([(a, e, r) for a in (-1, 0, 1) for e in (-1, 0, 1) for r in (-1, 0, 1)], np.int64)


@dataclass(frozen=True, slots=True)
class WeatherFilter:
    """Limits of the removal.

    Ours, 2026-11. The counts do not depend on the number of channels of the LiDAR.

    Attributes:
        cell_deg: angle of a cell as seen from the sensor, degrees. The depth of the cell is the same share of its range. So cells
            grow with the range, like the distance between beams. A neighbourhood has 3 x 3 x 3 cells.
        max_range_m: points beyond this range are kept, metres. Drops and flakes return too little light from there.
        min_neighbours: a neighbourhood with fewer points, including the point itself, is noise.
        solid_share: a neighbourhood is structure if it holds at least this share of all returns in its directions.
        flat_ratio: a neighbourhood below ``solid_share`` is still structure if its thickness divided by its width is below this
            ratio. It is then a plane or a line. Thickness and width are the roots of the smallest and the largest eigenvalue.
        plane_sigmas: largest distance of a point from the plane of its neighbourhood, as a multiple of the thickness. It removes
            a flake in front of a wall.
        plane_share: addition to this largest distance, as a share of the range.
    """

    cell_deg: float = 3.0
    max_range_m: float = 25.0
    min_neighbours: int = 5
    solid_share: float = 0.1
    flat_ratio: float = 0.12
    plane_sigmas: float = 2.5
    plane_share: float = 0.005


@dataclass(frozen=True, slots=True)
class _Neighbourhoods:
    """Neighbourhood of every point: the 3 x 3 x 3 cells around it.

    Attributes:
        count: points in the neighbourhood.
        count_at_any_range: points in the directions of the neighbourhood, at any range.
        mean: mean of the points, metres.
        normal: unit eigenvector of the smallest eigenvalue.
        eigenvalues: eigenvalues of the covariance, ascending, m^2.
    """

    count: Float64[NDArray[np.float64], " N"]
    count_at_any_range: Float64[NDArray[np.float64], " N"]
    mean: Float64[NDArray[np.float64], "N 3"]
    normal: Float64[NDArray[np.float64], "N 3"]
    eigenvalues: Float64[NDArray[np.float64], "N 3"]


def remove_weather_noise(points: Points, settings: WeatherFilter = WeatherFilter()) -> Bool[NDArray[np.bool_], " N"]:
    """Separate structure from rain and snow in a LiDAR scan.

    Args:
        points: metres, LiDAR frame. The beams start at the origin.
        settings: limits of the removal.

    Returns:
        True for points to keep. Points at the origin are not kept.
    """
    range_m = np.linalg.norm(points.astype(np.float64), axis=1)
    keep: NDArray[np.bool_] = np.asarray(range_m > settings.max_range_m)
    near = np.flatnonzero(~keep & (range_m > 0))
    if near.size == 0:
        return keep
    xyz = points[near].astype(np.float64)
    cells, turn = _cells(xyz, range_m[near], np.deg2rad(settings.cell_deg))
    around = _neighbourhoods(xyz, cells, turn)
    thickness, width = np.sqrt(around.eigenvalues[:, 0]), np.sqrt(around.eigenvalues[:, 2])
    off_plane = np.abs(((xyz - around.mean) * around.normal).sum(axis=1))
    lies_on = off_plane <= settings.plane_sigmas * thickness + settings.plane_share * range_m[near]
    flat = thickness < settings.flat_ratio * width
    solid = around.count >= settings.solid_share * around.count_at_any_range
    keep[near] = (around.count >= settings.min_neighbours) & lies_on & (solid | flat)
    return keep


def _cells(
    xyz: Float64[NDArray[np.float64], "N 3"], range_m: Float64[NDArray[np.float64], " N"], cell_rad: float
) -> tuple[Int64[NDArray[np.int64], "N 3"], int]:
    """Assign every point to a cell of azimuth, elevation and logarithm of the range.

    The second result is the number of cells in 360 degrees of azimuth.
    """
    turn = max(3, round(2 * np.pi / cell_rad))
    x, y, z = xyz.T
    azimuth = np.floor((np.arctan2(y, x) + np.pi) / (2 * np.pi) * turn).astype(np.int64) % turn
    elevation = np.floor(np.arctan2(z, np.hypot(x, y)) / cell_rad).astype(np.int64)
    depth = np.floor(np.log(range_m) / cell_rad).astype(np.int64)
    return np.stack([azimuth, elevation, depth], axis=1), turn


def _neighbourhoods(
    xyz: Float64[NDArray[np.float64], "N 3"], cells: Int64[NDArray[np.int64], "N 3"], turn: int
) -> _Neighbourhoods:
    """Compute the covariance (paper, eq. 2) and its principal components for the cells around every point."""
    unique, cell_of_point = np.unique(cells, axis=0, return_inverse=True)
    cell_of_point = cell_of_point.reshape(-1)
    moments = np.concatenate([np.ones((len(xyz), 1)), xyz, (xyz[:, :, None] * xyz[:, None, :]).reshape(-1, 9)], axis=1)
    of_cell = _sums(moments, cell_of_point, len(unique))
    around = _sums_around(unique, unique, of_cell, _AROUND, turn)
    directions, direction_of_cell = np.unique(unique[:, :2], axis=0, return_inverse=True)
    returns = _sums(of_cell[:, :1], direction_of_cell.reshape(-1), len(directions))
    offsets = np.unique(_AROUND[:, :2], axis=0)
    total = _sums_around(unique[:, :2], directions, returns, offsets, turn)[:, 0]
    count = around[:, 0]
    mean = around[:, 1:4] / count[:, None]
    covariance = around[:, 4:].reshape(-1, 3, 3) / count[:, None, None] - mean[:, :, None] * mean[:, None, :]
    eigenvalues, components = np.linalg.eigh(covariance)
    return _Neighbourhoods(
        count[cell_of_point],
        total[cell_of_point],
        mean[cell_of_point],
        components[cell_of_point, :, 0],
        np.maximum(eigenvalues, 0)[cell_of_point],
    )


def _sums(
    values: Float64[NDArray[np.float64], "N M"], group: Int64[NDArray[np.int64], " N"], groups: int
) -> Float64[NDArray[np.float64], "G M"]:
    return np.stack([np.bincount(group, values[:, n], groups) for n in range(values.shape[1])], axis=1)


def _sums_around(
    wanted: Int64[NDArray[np.int64], "N D"],
    cells: Int64[NDArray[np.int64], "G D"],
    values: Float64[NDArray[np.float64], "G M"],
    offsets: Int64[NDArray[np.int64], "K D"],
    turn: int,
) -> Float64[NDArray[np.float64], "N M"]:
    """Sum the values of the cells at every offset from each wanted cell. The first index, azimuth, is periodic."""
    low = cells.min(axis=0) - 2
    size = cells.max(axis=0) + 2 - low + 1
    keys = _keys(cells, low, size)
    order = np.argsort(keys)
    keys = keys[order]
    result = np.zeros((len(wanted), values.shape[1]))
    for offset in offsets:
        neighbour = wanted + offset
        neighbour[:, 0] %= turn
        inside = (neighbour[:, 0] >= low[0]) & (neighbour[:, 0] < low[0] + size[0])
        key = _keys(neighbour, low, size)
        at = np.minimum(np.searchsorted(keys, key), len(keys) - 1)
        hit = inside & (keys[at] == key)
        result[hit] += values[order[at[hit]]]
    return result


def _keys(
    cells: Shaped[NDArray[np.int64], "N D"], low: Int64[NDArray[np.int64], " D"], size: Int64[NDArray[np.int64], " D"]
) -> Int64[NDArray[np.int64], " N"]:
    """Combine the indices of each cell into one unique number."""
    key = np.zeros(len(cells), np.int64)
    for n in range(cells.shape[1]):
        key = key * size[n] + (cells[:, n] - low[n])
    return key
