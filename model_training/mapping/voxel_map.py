"""Accumulate scans in voxels and compute the surfels of the map cloud.

Each voxel stores the moments of its points: count, sum, sum of products. So the memory depends on the number of voxels, not of points.
The normal of a voxel is the axis of least variance of its moments and those of its 26 neighbours. The neighbours have less weight.
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

#: Number of cells along an axis. A key has 3 x 20 bits.
_SPAN = 1 << 20
#: Largest distance of a cell from the origin, in cells, up to which it and its neighbours have unique keys.
_FARTHEST = _SPAN // 2 - 2
#: Columns of the second moments.
_SECOND = slice(4, 10)
#: Number of columns: count, x, y, z, xx, xy, xz, yy, yz, zz about the voxel's centre; sum of brightness, number of points that have one.
_MOMENTS, _BRIGHT = 12, slice(10, 12)
#: Weight of a neighbour's points in a normal, by the number of axes along which it is displaced. Equal weights smooth the balconies and
#: recesses of a facade into one slope. Smaller weights (0.1, 0.02, 0.005) follow the noise of the survey (decision 0098).
_NEIGHBOUR = (1.0, 0.3, 0.1, 0.03)
#: Smallest number of waiting rows of sums that starts a merge.
_WAITING = 1 << 20

#: A voxel as a bundle stores it, for merging maps. ``cell``: its cell; all maps of one edge share one lattice through the zero of the map
#: frame. ``points``: number of points. ``sums``: their sums (m) and sums of products (m2) about the voxel's centre.
#: ``brightness``: sum of brightness. ``bright_points``: number of points that have one.
VOXEL = np.dtype(
    [("cell", "<i4", (3,)), ("points", "<u4"), ("sums", "<f4", (9,)), ("brightness", "<f4"), ("bright_points", "<u4")]
)


@dataclass(frozen=True)
class Surfels:
    """Surface elements, one per voxel with enough points.

    Attributes:
        positions: mean of the voxel's points, metres, map frame (n, 3).
        normals: unit normals, map frame (n, 3).
        thickness_m: standard deviation across the surface, metres (n,).
        points: number of points in the voxel (n,).
        keys: key of the voxel (n,).
        brightness: mean intensity of the voxel's returns as the sensor gives it, NaN where unknown (n,).
    """

    positions: NDArray[np.float64]
    normals: NDArray[np.float32]
    thickness_m: NDArray[np.float32]
    points: NDArray[np.uint32]
    keys: NDArray[np.int64]
    brightness: NDArray[np.float32]


class VoxelMap:
    """Moments of points in voxels; ``surfels`` computes the surfels.

    The number of keys limits the reach (``reach_m``): 157 km from the origin along each axis with voxels of 0.3 m. A method that adds
    points beyond it raises ``DatasetError``.

    Args:
        voxel_m: edge of a voxel, metres.
        origin: corner of a cell near the middle of the map, metres, map frame (3,). Coordinates stay small around it. With an origin
            from ``lattice_origin``, all maps of one edge share their voxels.
    """

    def __init__(self, voxel_m: float, origin: NDArray[np.float64]) -> None:
        self.voxel_m, self.origin = voxel_m, origin
        self._keys = np.zeros(0, np.int64)
        self._moments = np.zeros((0, _MOMENTS))
        self._waiting: list[tuple[NDArray[np.int64], NDArray[np.float64]]] = []

    @property
    def reach_m(self) -> float:
        """Largest distance of a point from the origin along each axis, metres."""
        return _FARTHEST * self.voxel_m

    def require_within(self, positions: NDArray[np.float64], what: Callable[[int], str]) -> None:
        """Refuse positions beyond the reach of the map.

        Args:
            positions: metres, map frame (n, 3).
            what: returns a name for the position of an index, for the error message.

        Raises:
            DatasetError: a position is too far away or not finite. The message names the farthest one.
        """
        away = np.abs(positions - self.origin).max(axis=1, initial=0.0)
        away[~np.isfinite(away)] = np.inf
        if len(away) and away.max() > self.reach_m:
            farthest = int(away.argmax())
            raise DatasetError(
                f"{what(farthest)} is {away[farthest] / 1000:,.0f} km from the middle of the map, but "
                f"a map with voxels of {self.voxel_m:g} m reaches {self.reach_m / 1000:.0f} km; "
                "transform all poses into one frame (are some UTM?), or build a map of each area",
                field="poses",
            )

    def add(self, points_map: NDArray[np.float64], intensity: NDArray[np.floating[Any]] | None = None) -> None:
        """Add points.

        Args:
            points_map: metres, map frame (n, 3).
            intensity: intensity of their returns (n,); None if unknown.

        Raises:
            DatasetError: a point lies beyond the reach of the map.
        """
        cell = self._cells(points_map)
        local = (points_map - self.origin) - (cell + 0.5) * self.voxel_m
        moments = _moments_of(local)
        if intensity is not None:
            moments[:, _BRIGHT] = np.stack([intensity, np.ones(len(intensity))], axis=1)
        self.add_sums(*_summed(_keys_of_cells(cell), moments))

    def add_sums(self, keys: NDArray[np.int64], moments: NDArray[np.float64]) -> None:
        """Add the ``sums`` of another map with the same voxel edge and the same origin.

        Args:
            keys: keys of the voxels (n,).
            moments: moments of the voxels (n, 12).
        """
        self._waiting.append((keys, moments))
        # The limit grows with the map, so even a large map is seldom copied. It depends on the added rows only, so the same calls give
        # the same rounding.
        if sum(len(k) for k, _ in self._waiting) >= max(_WAITING, len(self._keys) // 4):
            self._merge()

    def sums(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return the keys of all voxels, ascending (n,), and their moments about the voxel's centre (n, 12)."""
        self._merge()
        return self._keys, self._moments

    def keys_of(self, points_map: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the key of the voxel of each point (n,).

        Args:
            points_map: metres, map frame (n, 3).

        Raises:
            DatasetError: a point lies beyond the reach of the map.
        """
        return _keys_of_cells(self._cells(points_map))

    def keep(self, wanted: NDArray[np.bool_]) -> None:
        """Keep some voxels and remove the others.

        Args:
            wanted: True for the voxels to keep, in the order of ``sums`` (n,).
        """
        self._merge()
        self._keys, self._moments = self._keys[wanted], self._moments[wanted]

    def means(self) -> NDArray[np.float64]:
        """Return the mean of each voxel's points (n, 3), metres, map frame, in the order of ``sums``."""
        keys, moments = self.sums()
        return self.origin + (_cells_of_keys(keys) + 0.5) * self.voxel_m + moments[:, 1:4] / moments[:, :1]

    def statistics(self) -> NDArray[Any]:
        """Return all voxels in the format of a bundle: (n,) of ``VOXEL``. The origin must come from ``lattice_origin``."""
        keys, moments = self.sums()
        found = np.zeros(len(keys), VOXEL)
        found["cell"] = _cells_of_keys(keys) + self._lattice()
        found["points"], found["sums"] = moments[:, 0], moments[:, 1 : _BRIGHT.start]
        found["brightness"], found["bright_points"] = moments[:, _BRIGHT].T
        return found

    def add_statistics(self, statistics: NDArray[Any]) -> None:
        """Add the ``statistics`` of another map with the same voxel edge.

        Single precision changes a mean by less than a micrometre.

        Args:
            statistics: (n,) of ``VOXEL``.

        Raises:
            DatasetError: a voxel lies beyond the reach of this map.
        """
        cell = statistics["cell"].astype(np.int64) - self._lattice()
        self.require_within(self.origin + cell * self.voxel_m, lambda _: "a voxel of the added map")
        keys = _keys_of_cells(cell)
        moments = np.zeros((len(keys), _MOMENTS))
        moments[:, 0], moments[:, 1 : _BRIGHT.start] = statistics["points"], statistics["sums"]
        moments[:, _BRIGHT] = np.stack([statistics["brightness"], statistics["bright_points"]], axis=1)
        self.add_sums(*_summed(keys, moments))

    def add_moments(self, means: NDArray[np.float64], points: NDArray[Any], covariances: NDArray[np.float64]) -> None:
        """Add groups of points by their moments. A group goes into the voxel of its mean.

        Args:
            means: mean of each group, metres, map frame (n, 3).
            points: number of points of each group (n,).
            covariances: covariance of each group, square metres (n, 3, 3).

        Raises:
            DatasetError: a mean lies beyond the reach of the map.
        """
        cell = self._cells(means)
        moments = _moments_of((means - self.origin) - (cell + 0.5) * self.voxel_m)
        moments[:, _SECOND] += covariances[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
        self.add_sums(*_summed(_keys_of_cells(cell), moments * points.astype(np.float64)[:, None]))

    def _cells(self, points_map: NDArray[np.float64]) -> NDArray[np.int64]:
        cell = np.floor((points_map - self.origin) / self.voxel_m)
        if not (np.abs(cell) <= _FARTHEST).all():  # written so that NaN is refused too
            self.require_within(points_map, lambda number: f"a point at {np.round(points_map[number]).tolist()} m")
        return cell.astype(np.int64)

    def _lattice(self) -> NDArray[np.int64]:
        """Return the lattice cell whose corner is the origin."""
        return np.rint(self.origin / self.voxel_m).astype(np.int64)

    def _merge(self) -> None:
        if not self._waiting:
            return
        keys = np.concatenate([self._keys, *(k for k, _ in self._waiting)])
        moments = np.concatenate([self._moments, *(m for _, m in self._waiting)])
        self._keys, self._moments = _summed(keys, moments)
        self._waiting = []

    def surfels(self, *, fewest: int = 5) -> "Surfels":
        """Compute one surfel for each voxel with enough points for a normal.

        Args:
            fewest: smallest number of points in the voxel and its 26 neighbours together.
        """
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
        """Sort surfels by tile, in the format of ``SurfelMap.prepare``.

        The positions are float32. Their resolution is 0.1 mm up to 1 km from the origin, and 1 mm up to 16 km.

        Args:
            found: the surfels.

        Returns:
            Surfels (n,) of ``SURFEL`` with positions relative to ``origin``; tiles (T, 4): centre x, y (metres, same frame), first surfel
            and number of surfels; brightness of each surfel (n,).
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
    """Return the corner (3,) of the common voxel lattice that is nearest to a point, metres, map frame.

    Args:
        voxel_m: edge of a voxel, metres.
        near: the point, metres, map frame (3,).
    """
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
    """Add up the rows of equal key; the keys become ascending."""
    order = np.argsort(keys, kind="stable")
    keys, moments = keys[order], moments[order]
    first = np.flatnonzero(np.r_[True, keys[1:] != keys[:-1]]) if len(keys) else np.zeros(0, np.int64)
    return keys[first], np.add.reduceat(moments, first, axis=0) if len(first) else moments


def _shifted(moments: NDArray[np.float64], shift: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the moments after every point has moved by ``shift`` (3,)."""
    n, s = moments[:, :1], moments[:, 1:4]
    a, b, c = shift
    moved = moments.copy()
    moved[:, 1:4] += n * shift
    x, y, z = s.T
    n0 = moments[:, 0]
    moved[:, _SECOND] += np.stack(
        [
            2 * a * x + n0 * a * a,
            a * y + b * x + n0 * a * b,
            a * z + c * x + n0 * a * c,
            2 * b * y + n0 * b * b,
            b * z + c * y + n0 * b * c,
            2 * c * z + n0 * c * c,
        ],
        axis=1,
    )
    return moved


def _covariances(moments: NDArray[np.float64]) -> NDArray[np.float64]:
    n = moments[:, :1]
    mean = moments[:, 1:4] / n
    second = moments[:, _SECOND] / n
    index = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
    covariances: NDArray[np.float64] = second[:, index] - mean[:, :, None] * mean[:, None, :]
    return covariances
