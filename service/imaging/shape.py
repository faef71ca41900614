"""How much there is to tell apart in what a picture shows: a bare wall says less than a crossing, wherever it is held against a map."""

from dataclasses import dataclass
from functools import cache

import numpy as np
from jaxtyping import Float32
from numpy.typing import NDArray

from service.imaging.view_grid import ViewGrid

#: Cells between the points that span a surface's tilt; more of them, less of the depth's noise in it.
_APART = 3
#: Neighbours whose ranges differ by more than this share lie on two surfaces; and cells that are ``_APART`` by more than this.
_EDGE, _BREAK = 0.15, 0.3
#: Of a normal's length; what is more level than this is ground or ceiling.
_UPRIGHT = 0.7
#: Rows from this elevation on look over the ground, degrees.
_LEVEL_DEG = 1.0
_FEWEST = 20
_LEAST = 1e-3


@dataclass(frozen=True, slots=True)
class Shape:
    """Figures of one view.

    Attributes:
        facings: how much upright surfaces face different ways: logarithm of the smaller eigenvalue of their horizontal normals'
            mean outer product; log 0.5 where all ways are alike, log 0.001 where all face one way.
        far: logarithm of the median range (m) above the horizon; of the grid's limit where hardly anything is measured there.
        edges: share of neighbouring cells, in a row, that lie on two surfaces.
    """

    facings: float
    far: float
    edges: float


def shape_of(ranges_m: Float32[NDArray[np.float32], "rows columns"], grid: ViewGrid) -> Shape:
    """Of the ranges of one view (m), 0 where nothing was measured."""
    above = ranges_m[grid.elevations_rad > np.deg2rad(_LEVEL_DEG)]
    above = above[above > 0]
    far = float(np.median(above)) if len(above) > _FEWEST else grid.max_range_m
    one, other = ranges_m[:, 1:], ranges_m[:, :-1]
    both = (one > 0) & (other > 0)
    broken = both & (np.abs(one - other) > _EDGE * np.minimum(one, other))
    return Shape(_facings(ranges_m, grid), float(np.log(far)), float(broken.sum() / max(1, both.sum())))


def _facings(ranges_m: Float32[NDArray[np.float32], "rows columns"], grid: ViewGrid) -> float:
    corner, right, below = np.s_[:-_APART, :-_APART], np.s_[:-_APART, _APART:], np.s_[_APART:, :-_APART]
    here, beside, under = ranges_m[corner], ranges_m[right], ranges_m[below]
    one = (here > 0) & (beside > 0) & (under > 0)
    one &= (np.abs(beside - here) <= _BREAK * here) & (np.abs(under - here) <= _BREAK * here)
    rays = _rays(grid)
    origin = rays[corner][one] * here[one, None]
    ax, ay, az = (rays[right][one] * beside[one, None] - origin).T
    bx, by, bz = (rays[below][one] * under[one, None] - origin).T
    x, y, z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    level = x * x + y * y
    upright = (level > 0) & (z * z < _UPRIGHT**2 * (level + z * z))
    if not upright.any():
        return float(np.log(_LEAST))
    x, y, level = x[upright], y[upright], level[upright]
    ways = np.stack([x, y]) / np.sqrt(level)
    smaller = float(np.linalg.eigvalsh(ways @ ways.T / len(x))[0])
    return float(np.log(max(smaller, 0.0) + _LEAST))


@cache
def _rays(grid: ViewGrid) -> Float32[NDArray[np.float32], "rows columns 3"]:
    return grid.rays_level().astype(np.float32)
