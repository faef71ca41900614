"""Accumulate scans in voxels and compute the surfels of the map cloud.

Each voxel stores the moments of its points: count, sum, sum of products, in single precision as in a bundle. So the memory depends on the
number of voxels, not of points: 56 bytes each, and half as much again while scans are added.
The normal of a voxel is the axis of least variance of its moments and those of its 26 neighbours. The neighbours have less weight.

Speed: the C code takes a quarter of the time of NumPy for the moments, and a sixth for the surfels (27 November 2026, decision 0166).
"""

import ctypes
from collections.abc import Callable, Iterator
from ctypes import c_double, c_int64, c_void_p
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from service.compiled import load
from service.errors import DatasetError
from service.maps.byte_planes import Columns
from service.registration.kernel import SURFEL

#: Library that the build compiles from ``voxels.c``.
LIBRARY = Path(__file__).with_name("_voxels.so")
#: Number of cells along an axis. A key has 3 x 20 bits.
SPAN = 1 << 20
#: Largest distance of a cell from the origin, in cells, up to which it and its neighbours have unique keys.
_FARTHEST = SPAN // 2 - 2
#: Columns of the second moments.
_SECOND = slice(4, 10)
#: Number of columns: count, x, y, z, xx, xy, xz, yy, yz, zz about the voxel's centre; sum of brightness, number of points that have one.
MOMENTS, _BRIGHT = 12, slice(10, 12)
#: Weight of a neighbour's points in a normal, by the number of axes along which it is displaced. Equal weights smooth the balconies and
#: recesses of a facade into one slope. Smaller weights (0.1, 0.02, 0.005) follow the noise of the survey (decision 0098).
_NEIGHBOUR = (1.0, 0.3, 0.1, 0.03)
#: Smallest number of points in a voxel and its 26 neighbours together that make a surfel.
FEWEST = 5
#: Number of voxels that are converted at a time, so that their copies stay small.
_PART = 1 << 18
#: Smallest number of waiting rows of sums that starts a merge.
_WAITING = 1 << 19
_NO_KEYS, _NO_MOMENTS = np.zeros(0, np.int64), np.zeros((0, MOMENTS), np.float32)
_Float = TypeVar("_Float", np.float32, np.float64)

#: A voxel as a bundle stores it, for merging maps. ``cell``: its cell; all maps of one edge share one lattice through the zero of the map
#: frame. ``points``: number of points. ``sums``: their sums (m) and sums of products (m2) about the voxel's centre.
#: ``brightness``: sum of brightness. ``bright_points``: number of points that have one.
VOXEL = np.dtype(
    [("cell", "<i4", (3,)), ("points", "<u4"), ("sums", "<f4", (9,)), ("brightness", "<f4"), ("bright_points", "<u4")]
)


@cache
def _library() -> ctypes.CDLL:
    arguments: dict[str, list[Any]] = {
        "surfels": [c_void_p, c_void_p, c_int64, c_double, c_void_p, c_double, c_void_p, c_void_p, c_void_p],
        "sums": [
            c_void_p, c_void_p, c_int64, c_void_p, c_double, c_int64,
            c_void_p, c_void_p, c_int64, c_void_p, c_void_p, c_void_p, c_void_p, c_void_p,
        ],
        "rows": [
            c_void_p, c_int64, c_void_p, c_double, c_int64,
            c_void_p, c_void_p, c_int64, c_void_p, c_void_p, c_int64, c_void_p,
        ],
        "summed": [c_void_p, c_void_p, c_void_p, c_int64, c_void_p, c_void_p],
        "absorb": [c_void_p, c_void_p, c_int64, c_void_p, c_void_p, c_int64, c_void_p],
    }  # fmt: skip
    counts = {f"{name.upper()}_ARGUMENTS": len(given) for name, given in arguments.items()}
    library = load(LIBRARY, constants={"MOMENTS": MOMENTS, "SPAN": SPAN, **counts})
    for name, given in arguments.items():
        function = getattr(library, f"streetfix_{name}")
        function.argtypes, function.restype = given, None if name == "surfels" else c_int64
    return library


@dataclass(frozen=True, slots=True, eq=False)
class Surfaces:
    """The surface in each voxel with enough points.

    Attributes:
        rows: rows of these voxels in ``VoxelMap.sums``, ascending (n,).
        normals: unit normals of all voxels, map frame; not set where a voxel has no surface (N, 3).
        thickness_m: standard deviation across the surface of all voxels, metres; not set where a voxel has no surface (N,).
    """

    rows: NDArray[np.int32]
    normals: NDArray[np.float32]
    thickness_m: NDArray[np.float32]


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
        self._keys, self._moments = np.zeros(0, np.int64), np.zeros((0, MOMENTS), np.float32)
        self._waiting: list[tuple[NDArray[np.int64], NDArray[np.float32]]] = []

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
            ValueError: an array has another shape.
        """
        self._add(*self._sums_of(points_map, intensity))

    def add_from(
        self, points_map: NDArray[np.float64], source: NDArray[np.integer[Any]]
    ) -> tuple[NDArray[np.int64], NDArray[np.bool_], NDArray[np.int32]]:
        """Add points of several sources.

        Args:
            points_map: metres, map frame (n, 3).
            source: number of the source of each point, ascending (n,).

        Returns:
            The keys of the voxels of these points, ascending (k,); whether each has points of more than one source (k,); and the row of
            the voxel of each point among them (n,).

        Raises:
            DatasetError: a point lies beyond the reach of the map.
        """
        row_of = np.empty(len(points_map), np.int32)
        keys, moments = self._sums_of(points_map, None, row_of)
        self._add(keys, moments)
        first, last = np.empty((2, len(keys)), source.dtype)
        first[row_of[::-1]], last[row_of] = source[::-1], source  # the last of several values stays
        return keys, first != last, row_of

    def rows_of(self, points_map: NDArray[np.float64]) -> NDArray[np.int32]:
        """Return the rows in ``sums`` of the voxels that hold some of the points, ascending (k,).

        Args:
            points_map: metres, map frame (n, 3).

        Raises:
            DatasetError: a point lies beyond the reach of the map.
        """
        points, keys = np.ascontiguousarray(points_map, np.float64), self.sums()[0]
        rows = np.empty(len(points), np.int32)
        found = self._gathered("rows", points, (), (keys.ctypes.data, len(keys), rows.ctypes.data))
        return rows[:found].copy()

    def _sums_of(
        self,
        points_map: NDArray[np.float64],
        intensity: NDArray[np.floating[Any]] | None,
        row_of: NDArray[np.int32] | None = None,
    ) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Return the keys of the voxels of points, ascending (k,), and their moments (k, 12).

        Write the row of the voxel of each point to ``row_of`` (n,).
        """
        points = np.ascontiguousarray(points_map, np.float64)
        if intensity is not None and intensity.shape != (len(points),):
            raise ValueError(
                f"intensity: the shape {intensity.shape} does not fit {len(points)} points; give one number for each point"
            )
        bright = None if intensity is None else np.ascontiguousarray(intensity, np.float32)
        shape = (len(points), MOMENTS)
        sums, keys, moments = np.empty(shape), np.empty(len(points), np.int64), np.empty(shape, np.float32)
        found = self._gathered(
            "sums",
            points,
            (None if bright is None else bright.ctypes.data,),
            (
                sums.ctypes.data,
                keys.ctypes.data,
                moments.ctypes.data,
                None if row_of is None else row_of.ctypes.data,
            ),
        )
        return keys[:found].copy(), moments[:found].copy()

    def _gathered(
        self, name: str, points: NDArray[np.float64], more: tuple[int | None, ...], last: tuple[int | None, ...]
    ) -> int:
        """Call a function of the library that gathers points by voxel; return the number of voxels that it found.

        Args:
            name: ``sums`` or ``rows``.
            points: metres, map frame (n, 3).
            more: its arguments after the points.
            last: its last arguments.

        Raises:
            DatasetError: a point lies beyond the reach of the map.
            ValueError: the points have another shape.
        """
        if points.shape != (len(points), 3):
            raise ValueError(f"points: the shape {points.shape} is not (n, 3)")
        count, slot_bits = len(points), max(1, len(points).bit_length())
        keys, slots = np.empty(count, np.int64), np.empty(1 << slot_bits, np.int32)
        numbers, origin = np.empty((2, count), np.int32), np.ascontiguousarray(self.origin, np.float64)
        found: int = getattr(_library(), f"streetfix_{name}")(
            points.ctypes.data,
            *more,
            count,
            origin.ctypes.data,
            self.voxel_m,
            _FARTHEST,
            keys.ctypes.data,
            slots.ctypes.data,
            slot_bits,
            numbers.ctypes.data,
            *last,
        )
        if found < 0:
            self._cells(points)  # raises, and names the point, unless rounding puts it on the limit itself
            raise DatasetError(
                f"a point lies at the limit of the map, {self.reach_m / 1000:.0f} km from its middle", field="poses"
            )
        return found

    def add_sums(self, keys: NDArray[np.int64], moments: NDArray[np.floating[Any]]) -> None:
        """Add the ``sums`` of another map with the same voxel edge and the same origin.

        Args:
            keys: keys of the voxels (n,).
            moments: moments of the voxels (n, 12). They are copied.
        """
        self._add(keys, np.array(moments, np.float32))

    def _add(self, keys: NDArray[np.int64], moments: NDArray[np.floating[Any]]) -> None:
        self._waiting.append((keys, np.ascontiguousarray(moments, np.float32)))
        # The limit grows with the map, so the rows of a large map are seldom moved. It depends on the added rows only, so the same calls
        # give the same rounding.
        if sum(len(k) for k, _ in self._waiting) >= max(_WAITING, len(self._keys) // 4):
            self._merge()

    def sums(self) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Return the keys of all voxels, ascending (n,), and their moments about the voxel's centre (n, 12).

        The arrays are those of the map itself. If points are added later, they keep their length, and the moments of known voxels may
        change.
        """
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
        self._keys, self._moments = self._keys[wanted], self._moments.compress(wanted, axis=0)

    def means(self) -> NDArray[np.float64]:
        """Return the mean of each voxel's points (n, 3), metres, map frame, in the order of ``sums``."""
        self._merge()
        return self.means_of(slice(None))

    def means_of(self, voxels: NDArray[np.integer[Any]] | slice) -> NDArray[np.float64]:
        """Return the mean of the points of some voxels (n, 3), metres, map frame.

        Args:
            voxels: rows of the voxels in ``sums`` (n,).
        """
        self._merge()
        keys, points = self._keys[voxels], self._moments[voxels, 0].astype(np.float64)
        means = np.empty((len(keys), 3))
        for axis in range(3):  # one after the other: a large map has no room for all
            centre = self.origin[axis] + (_axis_of_keys(keys, axis) + 0.5) * self.voxel_m
            means[:, axis] = centre + self._moments[voxels, 1 + axis] / points
        return means

    def statistics(self) -> NDArray[Any]:
        """Return all voxels in the format of a bundle: (n,) of ``VOXEL``. The origin must come from ``lattice_origin``."""
        found = np.zeros(len(self.sums()[0]), VOXEL)
        words = found.view(np.uint32).reshape(len(found), VOXEL.itemsize // 4)
        for column, values in enumerate(self.columns().each()):
            words[:, column] = values.view(np.uint32)
        return found

    def columns(self) -> Columns:
        """Return all voxels in the format of a bundle, number by number.

        They are computed while they are written, so the map must not change before.
        """
        keys, moments = self.sums()
        corner = self._lattice()

        def cells(axis: int) -> NDArray[np.int32]:
            found = np.empty(len(keys), np.int32)
            for part in parts(len(keys)):
                found[part] = _axis_of_keys(keys[part], axis) + corner[axis]
            return found

        def each() -> Iterator[NDArray[Any]]:
            yield from map(cells, range(3))
            yield moments[:, 0].astype(np.uint32)
            for column in range(1, _BRIGHT.start + 1):
                yield np.ascontiguousarray(moments[:, column])
            yield moments[:, MOMENTS - 1].astype(np.uint32)

        return Columns(len(keys), VOXEL.itemsize // 4, each)

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
        moments = np.zeros((len(keys), MOMENTS), np.float32)
        moments[:, 0], moments[:, 1 : _BRIGHT.start] = statistics["points"], statistics["sums"]
        moments[:, _BRIGHT] = np.stack([statistics["brightness"], statistics["bright_points"]], axis=1)
        self._add(*_summed(keys, moments))

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
        self._add(*_summed(_keys_of_cells(cell), moments * points.astype(np.float64)[:, None]))

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
        keys, moments = (np.concatenate(each) for each in zip(*self._waiting, strict=True))
        self._waiting = []
        order = np.argsort(keys, kind="stable")
        added, sums = np.empty_like(keys), np.empty_like(moments)
        count = _library().streetfix_summed(
            keys.ctypes.data,
            moments.ctypes.data,
            order.ctypes.data,
            len(keys),
            added.ctypes.data,
            sums.ctypes.data,
        )
        del keys, moments, order  # a large map has no room for them while it grows
        before = np.empty(count, np.int64)
        unknown = _library().streetfix_absorb(
            self._keys.ctypes.data,
            self._moments.ctypes.data,
            len(self._keys),
            added.ctypes.data,
            sums.ctypes.data,
            count,
            before.ctypes.data,
        )
        if unknown:
            self._insert(before[:unknown], added[:unknown], sums[:unknown])

    def _insert(self, at: NDArray[np.int64], new_keys: NDArray[np.int64], new_moments: NDArray[np.float32]) -> None:
        """Insert voxels before some rows, as ``np.insert`` does. A large map has no room for a copy of itself, so it grows in place."""
        keys, moments, count, total = self._keys, self._moments, len(self._keys), len(self._keys) + len(at)
        # NumPy resizes an array only if a single variable refers to it.
        self._keys, self._moments = _NO_KEYS, _NO_MOMENTS
        try:
            keys.resize(total)
            moments.resize((total, MOMENTS))
            _insert_in_place(keys, count, at, new_keys)
            _insert_in_place(moments, count, at, new_moments)
        except ValueError:  # a caller of ``sums`` still has an array
            keys = np.insert(keys[:count], at, new_keys)
            moments = np.insert(moments, at, new_moments, axis=0)
        finally:
            self._keys, self._moments = keys, moments

    def surfaces(self, *, fewest: int = FEWEST) -> Surfaces:
        """Compute the surface in each voxel with enough points for a normal.

        Args:
            fewest: smallest number of points in the voxel and its 26 neighbours together.
        """
        self._merge()
        count = len(self._keys)
        around, normals, thickness = np.empty(count), np.empty((count, 3), np.float32), np.empty(count, np.float32)
        weights = np.array(_NEIGHBOUR)
        _library().streetfix_surfels(
            self._keys.ctypes.data,
            self._moments.ctypes.data,
            count,
            self.voxel_m,
            weights.ctypes.data,
            fewest,
            around.ctypes.data,
            normals.ctypes.data,
            thickness.ctypes.data,
        )
        enough = around >= fewest
        del around
        return Surfaces(np.flatnonzero(enough).astype(np.int32), normals, thickness)

    def surfels(self) -> tuple[NDArray[Any], NDArray[np.float32]]:
        """Compute the surfels, in the format of ``SurfelMap.prepare``.

        The positions are float32. Their resolution is 0.1 mm up to 1 km from the origin, and 1 mm up to 16 km. The surfels are filled in a
        part at a time: a map of five million surfels has no room for copies.

        Returns:
            Surfels (n,) of ``SURFEL`` with positions relative to ``origin``, and the brightness of each surfel (n,).
        """
        found = self.surfaces()
        surfels, brightness = np.zeros(len(found.rows), SURFEL), np.empty(len(found.rows), np.float32)
        for part in parts(len(found.rows)):
            of = found.rows[part]
            surfels["xyz"][part] = self.means_of(of) - self.origin
            surfels["normal"][part], surfels["thickness_m"][part] = found.normals[of], found.thickness_m[of]
            surfels["points"][part], brightness[part] = self._moments[of, 0], self._brightness_of(of)
        return surfels, brightness

    def _brightness_of(self, rows: NDArray[np.int32]) -> NDArray[np.float32]:
        total, count = (self._moments[rows, column] for column in (_BRIGHT.start, _BRIGHT.start + 1))
        mean: NDArray[np.float32] = np.divide(total, count, out=np.full(len(rows), np.nan, np.float32), where=count > 0)
        return mean


def lattice_origin(voxel_m: float, near: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the corner (3,) of the common voxel lattice that is nearest to a point, metres, map frame.

    Args:
        voxel_m: edge of a voxel, metres.
        near: the point, metres, map frame (3,).
    """
    return np.asarray(np.round(near / voxel_m) * voxel_m)


def _keys_of_cells(cell: NDArray[np.int64]) -> NDArray[np.int64]:
    shifted = cell + SPAN // 2
    return np.asarray((shifted[:, 0] * SPAN + shifted[:, 1]) * SPAN + shifted[:, 2])


def _axis_of_keys(keys: NDArray[np.int64], axis: int) -> NDArray[np.int64]:
    """Return the cell of each key along an axis (n,)."""
    return np.asarray(keys // SPAN ** (2 - axis) % SPAN - SPAN // 2)


def _moments_of(local: NDArray[np.float64]) -> NDArray[np.float64]:
    x, y, z = local.T
    unknown = np.zeros(len(x))
    return np.stack([np.ones(len(x)), x, y, z, x * x, x * y, x * z, y * y, y * z, z * z, unknown, unknown], axis=1)


def _summed(keys: NDArray[np.int64], moments: NDArray[_Float]) -> tuple[NDArray[np.int64], NDArray[_Float]]:
    """Add up the rows of equal key; the keys become ascending."""
    order = np.argsort(keys, kind="stable")
    keys, moments = keys[order], moments[order]
    first = _first_of_each(keys)
    return keys[first], np.add.reduceat(moments, first, axis=0) if len(first) else moments


def _insert_in_place(array: NDArray[Any], count: int, at: NDArray[np.int64], rows: NDArray[Any]) -> None:
    """Insert rows into an array in place.

    Args:
        array: the array; its rows from ``count`` on are free (count + f, ...).
        count: number of rows that it has.
        at: rows before which to insert, ascending, 0 to ``count`` (f,).
        rows: the new rows (f, ...).
    """
    for part in reversed(parts(count)):  # from the end, because a row only moves towards the end
        old = np.arange(part.start, part.stop)
        array[old + np.searchsorted(at, old, side="right")] = array[part].copy()
    array[at + np.arange(len(at))] = rows


def parts(count: int) -> list[slice]:
    """Return slices that cover ``count`` rows, so that copies of their values stay small.

    Args:
        count: number of rows.
    """
    return [slice(first, min(first + _PART, count)) for first in range(0, count, _PART)]


def ranked(count: int, numbers_of: Callable[[slice], NDArray[np.int64]]) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Return the distinct numbers of many rows, ascending (k,), and the index of each row's number among them (count,).

    An index takes four bytes, a number eight.

    Args:
        count: number of rows.
        numbers_of: returns the numbers of a slice of the rows. It is called twice for each.
    """
    found = np.zeros(0, np.int64)
    for part in parts(count):
        found = np.union1d(found, numbers_of(part))
    rank = np.empty(count, np.int32)
    for part in parts(count):
        rank[part] = np.searchsorted(found, numbers_of(part))
    return found, rank


def _first_of_each(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the position of the first of each run of equal keys (n,)."""
    return np.flatnonzero(np.r_[True, keys[1:] != keys[:-1]]) if len(keys) else np.zeros(0, np.int64)
