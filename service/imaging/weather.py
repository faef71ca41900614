"""Removal of rain and snow from a LiDAR scan by the principal components of each point's neighbourhood.

The paper's reference 19 cleans clouds by PCA and stops there; which components mean noise is ours (2026-11). Drops and
flakes hang alone in the air near the sensor: few of the beams that pass them return from there, and those that do
lie on no line and no plane. Structure takes all the beams of its direction, or at least forms a line (a pole, a ring
of the scan on the ground) or a plane.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, Shaped
from numpy.typing import NDArray

Points = Float32[NDArray[np.float32], "N 3"]

_AROUND = np.array([(a, e, r) for a in (-1, 0, 1) for e in (-1, 0, 1) for r in (-1, 0, 1)], np.int64)


@dataclass(frozen=True, slots=True)
class WeatherFilter:
    """Limits of the removal. Ours, 2026-11; the counts do not depend on the number of channels.

    Attributes:
        cell_deg: side of a cell as seen from the sensor; its depth is the same share of its range, so that cells grow
            with the range as the distance between beams does. A neighbourhood is 3 x 3 x 3 cells.
        max_range_m: farther points are kept: drops and flakes return too little light from there.
        min_neighbours: a neighbourhood with fewer points, the point itself among them, is noise.
        solid_share: from this share of the returns of the neighbourhood's directions on, it is structure.
        flat_ratio: thickness over width (roots of the smallest and of the largest eigenvalue) under which a
            neighbourhood between the two is a plane or a line, and so structure.
        plane_sigmas: how far off the plane of its neighbourhood a point may lie, in thicknesses of the neighbourhood:
            a flake before a wall is not the wall.
        plane_share: and how far beyond that, as a share of its range.
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
    """Of every point: what the 3 x 3 x 3 cells around it hold, and how many points lie in their directions at all."""

    count: Float64[NDArray[np.float64], " N"]
    count_at_any_range: Float64[NDArray[np.float64], " N"]
    mean: Float64[NDArray[np.float64], "N 3"]
    normal: Float64[NDArray[np.float64], "N 3"]
    eigenvalues: Float64[NDArray[np.float64], "N 3"]


def remove_weather_noise(points: Points, settings: WeatherFilter = WeatherFilter()) -> Bool[NDArray[np.bool_], " N"]:
    """Tell structure from rain and snow.

    Args:
        points: metres, in the LiDAR's frame: the origin is where the beams start.
        settings: limits of the removal.

    Returns:
        True for the points to keep.
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
    """Cell of every point by azimuth, elevation and logarithm of the range, and the number of cells in a turn."""
    turn = max(3, round(2 * np.pi / cell_rad))
    x, y, z = xyz.T
    azimuth = np.floor((np.arctan2(y, x) + np.pi) / (2 * np.pi) * turn).astype(np.int64) % turn
    elevation = np.floor(np.arctan2(z, np.hypot(x, y)) / cell_rad).astype(np.int64)
    depth = np.floor(np.log(range_m) / cell_rad).astype(np.int64)
    return np.stack([azimuth, elevation, depth], axis=1), turn


def _neighbourhoods(
    xyz: Float64[NDArray[np.float64], "N 3"], cells: Int64[NDArray[np.int64], "N 3"], turn: int
) -> _Neighbourhoods:
    """Describe the cells around every point: covariance (paper, eq. 2) and its principal components, m2 ascending."""
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
    """Add up the values of the cells at every offset from each wanted cell; azimuth, the first number, is a circle."""
    low = cells.min(axis=0) - 2
    size = cells.max(axis=0) + 2 - low + 1
    keys = _keys(cells, low, size)
    order = np.argsort(keys)
    keys = keys[order]
    result = np.zeros((len(wanted), values.shape[1]))
    for offset in offsets:
        there = wanted + offset
        there[:, 0] %= turn
        inside = (there[:, 0] >= low[0]) & (there[:, 0] < low[0] + size[0])
        key = _keys(there, low, size)
        at = np.minimum(np.searchsorted(keys, key), len(keys) - 1)
        hit = inside & (keys[at] == key)
        result[hit] += values[order[at[hit]]]
    return result


def _keys(
    cells: Shaped[NDArray[np.int64], "N D"], low: Int64[NDArray[np.int64], " D"], size: Int64[NDArray[np.int64], " D"]
) -> Int64[NDArray[np.int64], " N"]:
    """One number for each cell."""
    key = np.zeros(len(cells), np.int64)
    for n in range(cells.shape[1]):
        key = key * size[n] + (cells[:, n] - low[n])
    return key
