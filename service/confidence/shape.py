"""Statistics of a view that measure how distinctive its geometry is.

A bare wall constrains a pose less than a crossing, in any map.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
from jaxtyping import Float32
from numpy.typing import NDArray

from service.imaging.view_grid import ViewGrid

#: Cells between the points that span a surface normal. A larger distance reduces the effect of depth noise.
_APART = 3
#: Relative range difference above which two cells lie on different surfaces: for neighbours, and for cells ``_APART`` apart.
_EDGE, _BREAK = 0.15, 0.3
#: Largest vertical part of the unit normal of an upright surface. Other surfaces are ground or ceiling.
_UPRIGHT = 0.7
#: Rows above this elevation do not look at the ground, degrees.
_LEVEL_DEG = 1.0
#: ``Shape.far`` needs more measured cells than this.
_FEWEST = 20
#: Offset under the logarithm of an eigenvalue. It keeps the logarithm finite.
_LEAST = 1e-3


@dataclass(frozen=True, slots=True)
class Shape:
    """Statistics of one view.

    Attributes:
        facings: variety of the directions that upright surfaces face. It is the logarithm of the smaller eigenvalue of the mean
            outer product of their horizontal unit normals. About log 0.5: all directions are equally frequent. log 0.001: all
            surfaces face one direction, or there is no upright surface.
        far: logarithm of the median range (m) above the horizon. With 20 measured cells or fewer, of the grid's largest range.
        edges: share of horizontally neighbouring measured cells that lie on different surfaces.
    """

    facings: float
    far: float
    edges: float


def shape_of(ranges_m: Float32[NDArray[np.float32], "rows columns"], grid: ViewGrid) -> Shape:
    """Compute the statistics of one view.

    Args:
        ranges_m: range of each cell, metres, 0 where nothing was measured.
        grid: view grid of the ranges.
    """
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
