"""Principal component analysis of scans (paper, section 2.IV and 2.V, eq. 2-8).

Levelling makes the local ground lie flat and counts heights from it: the paper's way of having no negative z.
The principal heading is the direction in which the things of a levelled scan are lined up: the street.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64
from numpy.typing import NDArray

from service.geometry.rigid import Rotation, rotation_taking

Cloud = Float[NDArray[np.floating], "N 3"]

GROUND_REACH_M = 18.0  # how far from the sensor the ground may speak of the local level
GROUND_NEAR_M = 2.0  # nearer points are the vehicle's own
GROUND_CELL_M = 1.0  # one point a cell, or the dense near field decides alone

HEADING_CELL_M = 0.5  # one vote a column, or the nearest wall would decide alone
HEADING_WINDOW = 3  # columns to each side whose axis a column votes for
HEADING_FEWEST = 5  # columns that make a line


@dataclass(frozen=True, slots=True)
class Components:
    """Eigenvectors (columns of ``axes``, largest variance first), variances (m2) and the mean (m)."""

    mean: Float64[NDArray[np.float64], " D"]
    axes: Float64[NDArray[np.float64], "D D"]
    variances: Float64[NDArray[np.float64], " D"]


@dataclass(frozen=True, slots=True)
class Level:
    """A scan's local level: ``R_level_sensor`` turns sensor axes upright, the ground then lies at -``height_m``."""

    R_level_sensor: Rotation
    height_m: float


def covariance(points: Float[NDArray[np.floating], "N D"]) -> Float64[NDArray[np.float64], "D D"]:
    """Covariance matrix over the points, normalised by N (paper, eq. 2)."""
    centred = np.asarray(points, np.float64) - np.mean(points, axis=0, dtype=np.float64)
    product: Float64[NDArray[np.float64], "D D"] = centred.T @ centred / max(1, len(points))
    return product


def principal_components(points: Float[NDArray[np.floating], "N D"]) -> Components:
    """Ordered eigenvectors of the covariance (paper, eq. 3-4); signs make each axis's largest entry positive."""
    variances, axes = np.linalg.eigh(covariance(points))
    variances, axes = variances[::-1].copy(), axes[:, ::-1].copy()
    signs = np.sign(axes[np.argmax(np.abs(axes), axis=0), np.arange(axes.shape[1])])
    return Components(np.mean(points, axis=0, dtype=np.float64), axes * signs, np.maximum(variances, 0.0))


def project(points: Float[NDArray[np.floating], "N D"], components: Components) -> Float64[NDArray[np.float64], "N D"]:
    """Coordinates along the principal axes (paper, eq. 5: Y = X A), about the mean."""
    result: Float64[NDArray[np.float64], "N D"] = (np.asarray(points, np.float64) - components.mean) @ components.axes
    return result


def level_scan(points: Cloud, *, expected_height_m: float = 1.8, height_slack_m: float = 1.0) -> Level:
    """Find the local ground of a scan by PCA of its lowest points and turn it flat.

    The lowest point of each 1 m cell within 18 m stands for the ground; a plane is fitted by PCA (its normal is the
    axis of least variance), points far from it are dropped, and again, with a narrowing band.

    Args:
        points: metres, sensor axes (x forward, y left, z roughly up, within some 15 degrees).
        expected_height_m: of the sensor above the ground, where the search starts.
        height_slack_m: how wrong that may be.

    Returns:
        The level; with too little ground in sight it is the sensor's own level at the expected height.
    """
    candidates = _lowest_of_cells(np.asarray(points, np.float64), expected_height_m, height_slack_m)
    if len(candidates) < 12:
        return Level(np.eye(3), expected_height_m)
    normal, offset = np.array([0.0, 0.0, 1.0]), float(np.quantile(candidates[:, 2], 0.3))
    radius = np.hypot(candidates[:, 0], candidates[:, 1])
    for band_m, band_slope in ((0.35, 0.10), (0.30, 0.05), (0.20, 0.025), (0.13, 0.01), (0.10, 0.0), (0.10, 0.0)):
        distance = candidates @ normal - offset
        near = candidates[np.abs(distance) < band_m + band_slope * radius]
        if len(near) < 12:
            break
        plane = principal_components(near)
        upward = plane.axes[:, 2] * np.sign(plane.axes[2, 2])
        # A patch that is long and thin leaves its cross slope open; then the last normal is the better one.
        if plane.variances[1] < 1.0 or upward[2] < np.cos(np.deg2rad(20.0)):
            break
        normal, offset = upward, float(upward @ plane.mean)
    return Level(rotation_taking(normal, np.array([0.0, 0.0, 1.0])), -offset)


def _lowest_of_cells(points: NDArray[np.float64], height_m: float, slack_m: float) -> NDArray[np.float64]:
    radius = np.hypot(points[:, 0], points[:, 1])
    low = (radius > GROUND_NEAR_M) & (radius < GROUND_REACH_M)
    low &= np.abs(points[:, 2] + height_m) < slack_m + 0.12 * radius
    near = points[low]
    if len(near) == 0:
        return near
    side = int(2 * GROUND_REACH_M / GROUND_CELL_M) + 2
    cell = ((near[:, :2] + GROUND_REACH_M) / GROUND_CELL_M).astype(np.int64)
    key = cell[:, 0] * side + cell[:, 1]
    order = np.lexsort((near[:, 2], key))
    first = np.unique(key[order], return_index=True)[1]
    chosen: NDArray[np.float64] = near[order[first]]
    return chosen


def principal_heading(
    points_level: Cloud, *, height_m: float, reach_m: float = 30.0, low_m: float = 0.5, high_m: float = 6.0
) -> float:
    """Direction of the street, radians in [-pi/2, pi/2): that along which most upright things around are lined up.

    Rotation about z by its negative (eq. 6) aligns the street with x. The principal axis of the whole scan swings with
    what happens to be in sight (in random cities 9 % of neighbours 1 m apart differ by over 10 degrees, here 2 %); so
    each 0.5 m column of points is asked for the principal axis (eq. 2-4) of the columns around it, and all vote. Walls
    along and across the street vote for one cross of axes; the majority says which arm is the street. Ours, 2026-11.

    Args:
        points_level: metres, levelled, origin at the sensor.
        height_m: of the sensor above the ground.
        reach_m: points further away are left out.
        low_m: lower bound of the heights that count, metres above the ground.
        high_m: upper bound of the same.
    """
    x, y = points_level[:, 0], points_level[:, 1]
    height = points_level[:, 2] + height_m
    keep = (height > low_m) & (height < high_m) & (np.hypot(x, y) < reach_m)
    column = ((np.asarray(points_level[keep, :2], np.float64) + reach_m) / HEADING_CELL_M).astype(np.int64)
    occupied = np.zeros((int(2 * reach_m / HEADING_CELL_M) + 2,) * 2)
    occupied[column[:, 0], column[:, 1]] = 1.0
    count, cxx, cxy, cyy = _moments_around(occupied, HEADING_WINDOW)[:, occupied > 0]
    enough = count >= HEADING_FEWEST
    # Length of ``axis2`` is the difference of the eigenvalues, its angle twice that of the larger one's axis.
    axis2, total = ((cxx - cyy) + 2j * cxy)[enough], (cxx + cyy)[enough]
    length = np.abs(axis2)
    larger, smaller = (total + length) / 2, np.maximum((total - length) / 2, 0.0)
    lined_up = 1.0 - np.sqrt(smaller / np.maximum(larger, 1e-12))
    votes = lined_up**2 * axis2 / np.maximum(length, 1e-12)
    if not len(votes):
        return 0.0
    cross = float(np.angle((votes * votes / np.maximum(np.abs(votes), 1e-12)).sum())) / 4
    along = float((votes * np.exp(-2j * cross)).real.sum())
    angle = cross if along >= 0 else cross + np.pi / 2
    return (angle + np.pi / 2) % np.pi - np.pi / 2


def _moments_around(occupied: NDArray[np.float64], window: int) -> NDArray[np.float64]:
    """Count and covariance xx, xy, yy (cells squared) of the occupied cells within a window of each: (4, n, n)."""
    at = np.arange(len(occupied)) - len(occupied) / 2
    x, y = np.meshgrid(at, at, indexing="ij")
    sums = occupied * np.stack([np.ones_like(x), x, y, x * x, x * y, y * y])
    corner = np.pad(sums, ((0, 0), (window + 1, window), (window + 1, window))).cumsum(axis=1).cumsum(axis=2)
    side = 2 * window + 1
    inside = corner[:, side:, side:] - corner[:, :-side, side:] - corner[:, side:, :-side] + corner[:, :-side, :-side]
    count = inside[0]
    mx, my, xx, xy, yy = inside[1:] / np.maximum(count, 1.0)
    return np.stack([count, xx - mx * mx, xy - mx * my, yy - my * my])
