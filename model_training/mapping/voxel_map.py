"""The map cloud for registration: voxels with mean, normal and thickness, from sums that add up scan by scan.

Each voxel keeps the moments of its points (count, sum, sum of products), so a drive of any length streams through. The
normal of a voxel is the axis of least variance of the moments of it and, for less, of its 26 neighbours.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.errors import DatasetError
from service.registration.kernel import SURFEL
from service.registration.surfel_map import TILE_M

_SPAN = 1 << 20  # cells along an axis: a key is 3 x 20 bits
#: Cells from the origin that have keys of their own, and whose neighbours have: beyond, two voxels would share a key.
_FARTHEST = _SPAN // 2 - 2
_SECOND = slice(4, 10)
#: Count, x, y, z, xx, xy, xz, yy, yz, zz about the voxel's centre; brightness, and how many points have one.
_MOMENTS, _BRIGHT = 12, slice(10, 12)
#: What a neighbour's points count for in a normal, by the number of axes it is away along: all alike, balconies and recesses of a facade
#: melt into one slope. Watch cities; fewer still (0.1, 0.02, 0.005) follow the survey's own noise.
_NEIGHBOUR = (1.0, 0.3, 0.1, 0.03)
_WAITING = 1 << 20  # rows of sums that wait to be merged, at least

#: What a bundle keeps of a voxel, so that maps can be merged: its cell (voxels of all maps of one edge lie on one lattice through
#: the map frame's zero), how many points it has, and their sums and sums of products about its centre (m, m2).
#: Last the sum of their brightnesses and the number of points that have one; older maps lack these two.
VOXEL_WITHOUT_BRIGHTNESS = np.dtype([("cell", "<i4", (3,)), ("points", "<u4"), ("sums", "<f4", (9,))])
VOXEL = np.dtype([*VOXEL_WITHOUT_BRIGHTNESS.descr, ("brightness", "<f4"), ("bright_points", "<u4")])


@dataclass(frozen=True)
class Surfels:
    """Surface elements: ``positions`` and unit ``normals`` (n, 3), ``thickness_m`` and ``points`` in the voxel, its ``keys`` (n).

    ``brightness`` (n) is the mean intensity of the voxel's returns as the sensor gives it, NaN where none was told.
    """

    positions: NDArray[np.float64]
    normals: NDArray[np.float32]
    thickness_m: NDArray[np.float32]
    points: NDArray[np.uint32]
    keys: NDArray[np.int64]
    brightness: NDArray[np.float32]


class VoxelMap:
    """Accumulates scans; ``tiles`` gives the surfels.

    It reaches as far as its keys do (``reach_m``): 157 km from its origin along each axis with voxels of 0.3 m. What adds points beyond
    that raises ``DatasetError``.

    Args:
        voxel_m: edge of a voxel.
        origin: a point near the map's middle, metres; coordinates stay small around it. ``lattice_origin`` gives one at which the
            voxels are those of other maps.
    """

    def __init__(self, voxel_m: float, origin: NDArray[np.float64]) -> None:
        self.voxel_m, self.origin = voxel_m, origin
        self._keys = np.zeros(0, np.int64)
        self._moments = np.zeros((0, _MOMENTS))
        self._waiting: list[tuple[NDArray[np.int64], NDArray[np.float64]]] = []

    @property
    def reach_m(self) -> float:
        """How far from the origin points may lie along each axis."""
        return _FARTHEST * self.voxel_m

    def require_within(self, positions: NDArray[np.float64], what: Callable[[int], str]) -> None:
        """Refuse positions (n, 3), metres, map frame, that lie beyond the map's reach; ``what`` says what one of them is.

        Raises:
            DatasetError: names the farthest of them.
        """
        away = np.abs(positions - self.origin).max(axis=1, initial=0.0)
        away[~np.isfinite(away)] = np.inf
        if len(away) and away.max() > self.reach_m:
            farthest = int(away.argmax())
            raise DatasetError(
                f"{what(farthest)} lies {away[farthest] / 1000:,.0f} km from the middle of the map, and a map with voxels of "
                f"{self.voxel_m:g} m reaches {self.reach_m / 1000:.0f} km; bring all poses into one frame (are some UTM?), or make a "
                "map of each area", field="poses",
            )  # fmt: skip

    def add(self, points_map: NDArray[np.float64], intensity: NDArray[np.floating[Any]] | None = None) -> None:
        """Add points (n, 3), metres, map frame, with the intensity of their returns (n), if it is known."""
        cell = self._cells(points_map)
        local = (points_map - self.origin) - (cell + 0.5) * self.voxel_m
        moments = _moments_of(local)
        if intensity is not None:
            moments[:, _BRIGHT] = np.stack([intensity, np.ones(len(intensity))], axis=1)
        self.add_sums(*_summed(_keys_of_cells(cell), moments))

    def add_sums(self, keys: NDArray[np.int64], moments: NDArray[np.float64]) -> None:
        """Add what ``sums`` of a map of the same voxels and the same origin gave."""
        self._waiting.append((keys, moments))
        # By the amount of what waits, so that a map of any size is copied seldom, and whoever adds the same gets the same.
        if sum(len(k) for k, _ in self._waiting) >= max(_WAITING, len(self._keys) // 4):
            self._merge()

    def sums(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Keys of all voxels, sorted, and their moments."""
        self._merge()
        return self._keys, self._moments

    def keys_of(self, points_map: NDArray[np.float64]) -> NDArray[np.int64]:
        """Key of the voxel that each point (n, 3), metres, map frame, lies in."""
        return _keys_of_cells(self._cells(points_map))

    def keep(self, wanted: NDArray[np.bool_]) -> None:
        """Forget the other voxels; one flag for each, in the order of ``sums``."""
        self._merge()
        self._keys, self._moments = self._keys[wanted], self._moments[wanted]

    def means(self) -> NDArray[np.float64]:
        """Mean of each voxel's points (n, 3), metres, map frame, in the order of ``sums``."""
        keys, moments = self.sums()
        return self.origin + (_cells_of_keys(keys) + 0.5) * self.voxel_m + moments[:, 1:4] / moments[:, :1]

    def statistics(self) -> NDArray[Any]:
        """All voxels as a bundle keeps them (``VOXEL``); the origin must be of the lattice."""
        keys, moments = self.sums()
        found = np.zeros(len(keys), VOXEL)
        found["cell"] = _cells_of_keys(keys) + self._lattice()
        found["points"], found["sums"] = moments[:, 0], moments[:, 1 : _BRIGHT.start]
        found["brightness"], found["bright_points"] = moments[:, _BRIGHT].T
        return found

    def add_statistics(self, statistics: NDArray[Any]) -> None:
        """Add what ``statistics`` of a map of the same voxels gave; single precision loses less than a micrometre of a mean."""
        cell = statistics["cell"].astype(np.int64) - self._lattice()
        self.require_within(self.origin + cell * self.voxel_m, lambda _: "a voxel of the added map")
        keys = _keys_of_cells(cell)
        moments = np.zeros((len(keys), _MOMENTS))
        moments[:, 0], moments[:, 1 : _BRIGHT.start] = statistics["points"], statistics["sums"]
        if statistics.dtype == VOXEL:
            moments[:, _BRIGHT] = np.stack([statistics["brightness"], statistics["bright_points"]], axis=1)
        self.add_sums(*_summed(keys, moments))

    def add_moments(self, means: NDArray[np.float64], points: NDArray[Any], covariances: NDArray[np.float64]) -> None:
        """Add groups of points of which only the mean (n, 3; m, map frame), number (n) and covariance (n, 3, 3; m2) are known.

        A group goes into the voxel that its mean lies in.
        """
        cell = self._cells(means)
        moments = _moments_of((means - self.origin) - (cell + 0.5) * self.voxel_m)
        moments[:, _SECOND] += covariances[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
        self.add_sums(*_summed(_keys_of_cells(cell), moments * points.astype(np.float64)[:, None]))

    def _cells(self, points_map: NDArray[np.float64]) -> NDArray[np.int64]:
        cell = np.floor((points_map - self.origin) / self.voxel_m)
        if not (np.abs(cell) <= _FARTHEST).all():  # a number that is not finite neither
            self.require_within(points_map, lambda number: f"a point at {np.round(points_map[number]).tolist()} m")
        return cell.astype(np.int64)

    def _lattice(self) -> NDArray[np.int64]:
        """Cell of the lattice that the origin is the corner of."""
        return np.rint(self.origin / self.voxel_m).astype(np.int64)

    def _merge(self) -> None:
        if not self._waiting:
            return
        keys = np.concatenate([self._keys, *(k for k, _ in self._waiting)])
        moments = np.concatenate([self._moments, *(m for _, m in self._waiting)])
        self._keys, self._moments = _summed(keys, moments)
        self._waiting = []

    def surfels(self, *, fewest: int = 5) -> "Surfels":
        """One for each voxel that has ``fewest`` points in it and around it, enough for a normal."""
        self._merge()
        keys, own = self._keys, self._moments
        total, around = np.zeros_like(own), np.zeros(len(own))
        for dx, dy, dz in product((-1, 0, 1), repeat=3):
            wanted = keys + ((dx * _SPAN) + dy) * _SPAN + dz
            at = np.searchsorted(keys, wanted)
            at[at == len(keys)] = 0
            found = keys[at] == wanted
            weight = _NEIGHBOUR[abs(dx) + abs(dy) + abs(dz)]
            total[found] += weight * _shifted(own[at[found]], np.array([dx, dy, dz]) * self.voxel_m)
            around[found] += own[at[found], 0]
        keep = around >= fewest
        keys, own, total = keys[keep], own[keep], total[keep]
        centre = self.origin + (_cells_of_keys(keys) + 0.5) * self.voxel_m
        variances, axes = np.linalg.eigh(_covariances(total))
        normals = axes[:, :, 0].astype(np.float32)
        thickness = np.sqrt(np.maximum(variances[:, 0], 0)).astype(np.float32)
        bright, told = own[:, _BRIGHT].T
        brightness = np.divide(bright, told, out=np.full(len(own), np.nan), where=told > 0).astype(np.float32)
        return Surfels(
            centre + own[:, 1:4] / own[:, :1], normals, thickness, own[:, 0].astype(np.uint32), keys, brightness
        )

    def tiles(self, found: "Surfels") -> tuple[NDArray[Any], NDArray[np.float64], NDArray[np.float32]]:
        """Surfels relative to ``origin``, sorted by tile; tiles (n, 4): centre x, y (m, same frame), first surfel, count; brightness.

        float32 holds a tenth of a millimetre as far as 1 km from the origin, and 1 mm as far as 16 km.
        """
        positions = found.positions - self.origin
        tile = np.floor(positions[:, :2] / TILE_M).astype(np.int64)
        order = np.lexsort((tile[:, 1], tile[:, 0]))
        corners, first, count = np.unique(tile[order], axis=0, return_index=True, return_counts=True)
        surfels = np.zeros(len(positions), SURFEL)
        surfels["xyz"] = positions[order]
        surfels["normal"], surfels["thickness_m"] = found.normals[order], found.thickness_m[order]
        surfels["points"] = found.points[order]
        return surfels, np.c_[(corners + 0.5) * TILE_M, first, count], found.brightness[order]


def lattice_origin(voxel_m: float, near: NDArray[np.float64]) -> NDArray[np.float64]:
    """The corner of the common lattice of voxels that is nearest to a point (3,), metres, map frame."""
    return np.asarray(np.round(near / voxel_m) * voxel_m)


def _keys_of_cells(cell: NDArray[np.int64]) -> NDArray[np.int64]:
    shifted = cell + _SPAN // 2
    return np.asarray((shifted[:, 0] * _SPAN + shifted[:, 1]) * _SPAN + shifted[:, 2])


def _cells_of_keys(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.stack([keys // (_SPAN * _SPAN), keys // _SPAN % _SPAN, keys % _SPAN], axis=1) - _SPAN // 2


def _moments_of(local: NDArray[np.float64]) -> NDArray[np.float64]:
    x, y, z = local.T
    unknown = np.zeros(len(x))
    return np.stack([np.ones(len(x)), x, y, z, x * x, x * y, x * z, y * y, y * z, z * z, unknown, unknown], axis=1)


def _summed(keys: NDArray[np.int64], moments: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Rows of equal key added up; keys sorted."""
    order = np.argsort(keys, kind="stable")
    keys, moments = keys[order], moments[order]
    first = np.flatnonzero(np.r_[True, keys[1:] != keys[:-1]]) if len(keys) else np.zeros(0, np.int64)
    return keys[first], np.add.reduceat(moments, first, axis=0) if len(first) else moments


def _shifted(moments: NDArray[np.float64], shift: NDArray[np.float64]) -> NDArray[np.float64]:
    """The same moments about a corner that lies ``shift`` (3,) away: every point moves by it."""
    n, s = moments[:, :1], moments[:, 1:4]
    a, b, c = shift
    moved = moments.copy()
    moved[:, 1:4] += n * shift
    x, y, z = s.T
    n0 = moments[:, 0]
    moved[:, _SECOND] += np.stack(
        [2 * a * x + n0 * a * a, a * y + b * x + n0 * a * b, a * z + c * x + n0 * a * c,
         2 * b * y + n0 * b * b, b * z + c * y + n0 * b * c, 2 * c * z + n0 * c * c], axis=1
    )  # fmt: skip
    return moved


def _covariances(moments: NDArray[np.float64]) -> NDArray[np.float64]:
    n = moments[:, :1]
    mean = moments[:, 1:4] / n
    second = moments[:, _SECOND] / n
    index = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
    covariances: NDArray[np.float64] = second[:, index] - mean[:, :, None] * mean[:, None, :]
    return covariances
