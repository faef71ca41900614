"""Find dynamic objects by a visibility vote: voxels that more passes of a survey see through than hit.

The vote is our own variant of the visibility tests of map cleaning (for example Kim and Kim, "Remove, then Revert", IROS 2020). It has
two safeguards:

- A pass that hits a voxel anywhere has no vote against it. So a thin pole that most rays miss stays.
- A ray that ends on the voxel's own plane does not see through it. Rays along the ground and along walls are such rays.

Every scan can also vote on its own (decision 0058). This finds traffic of a single pass: a vehicle ahead is hit once, and later scans
see through it. Later scans hit a static object again.

Passes are counted per tile of the ground. A tile that comes into reach again after enough travel elsewhere starts a new pass. A turn
within reach stays in the same pass. Votes are bits, one per pass, so their order does not matter.
"""

import ctypes
from collections.abc import Callable, Iterable
from ctypes import c_int64, c_void_p
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model_training.datasets.dataset import Dataset
from model_training.mapping.settings import BuildSettings
from model_training.mapping.survey import clear_scan, travelled_m
from model_training.mapping.tiles import TilePart
from model_training.mapping.voxel_map import MOMENTS, SPAN, VoxelMap, parts, ranked
from model_training.mapping.work import Arrays
from service.compiled import load
from service.geometry.lengths import lengths
from service.geometry.rigid import inverse, transform_points

#: Edge of a tile of the ground, metres.
TILE_M = 10.0
#: Largest range of a vote, metres. Farther away a beam is wider than the objects that it should see past.
REACH_M = 30.0
#: Travel outside the reach of a tile after which the next visit is a new pass, metres.
AWAY_M = 30.0
#: Largest number of a pass, counted from 0; later passes share it.
MOST = 63

#: Library that the build compiles from ``sight.c``.
LIBRARY = Path(__file__).with_name("_sight.so")
#: Size of the range image, whose cells have half a degree: elevations from -45 to 45 degrees, all azimuths.
_ROWS, _COLUMNS = 180, 720
#: Points nearer than this lie on the vehicle, metres.
_NEAREST_M = 2.0
#: Further distance of a tile whose voxels may be within reach, metres. It is much more than the rounding of a position.
_SLACK_M = 0.1
#: Number of tiles along an axis that have a number of their own.
_TILE_SPAN = 1 << 24


@cache
def _library() -> ctypes.CDLL:
    arguments: list[Any] = [
        c_void_p, c_int64, c_void_p, c_void_p, c_void_p, c_void_p, c_void_p, c_int64,
        c_void_p, c_void_p, c_void_p, c_void_p, c_void_p, c_void_p,
    ]  # fmt: skip
    image, voxels = {"ROWS": _ROWS, "COLUMNS": _COLUMNS}, {"MOMENTS": MOMENTS, "SPAN": SPAN}
    library = load(LIBRARY, constants={**image, **voxels, "ARGUMENTS": len(arguments)})
    library.streetfix_looked_through.argtypes = arguments
    library.streetfix_looked_through.restype = c_int64
    return library


@dataclass(frozen=True, eq=False)
class Passes:
    """The pass that each scan belongs to, for each tile within its reach.

    Attributes:
        tiles: numbers of the tiles within reach of each scan, ascending, as from ``tile_of`` (n, K).
        number: number of the pass over each of these tiles, 0 to ``MOST`` (n, K).
    """

    tiles: NDArray[np.int64]
    number: NDArray[np.uint64]

    @classmethod
    def of(
        cls, poses: NDArray[np.float64], *, spacing_m: float = 1.0, travelled: NDArray[np.float64] | None = None
    ) -> "Passes":
        """Count the passes of a traversal over each tile.

        Args:
            poses: T_map_lidar of the scans in the order of the traversal (n, 4, 4).
            spacing_m: usual distance between successive scans, metres. A gap of less than three spacings starts no new pass.
            travelled: travelled distance from the first scan of the survey to each scan, metres (n,); None computes it from the poses,
                which must then be the whole traversal.
        """
        half = int(np.ceil(REACH_M / TILE_M)) + 1
        steps = np.arange(-half, half + 1)
        around = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
        # Keep a tile if any of its points can be within reach of any point of the middle tile.
        around = around[(np.maximum(np.abs(around) - 1, 0) ** 2).sum(axis=1) * TILE_M**2 <= REACH_M**2]
        tiles = np.sort(_numbered(np.floor(poses[:, None, :2, 3] / TILE_M).astype(np.int64) + around), axis=1)
        flat = tiles.ravel()
        order = np.argsort(flat, kind="stable")  # by tile, then in the order of the traversal
        way = np.repeat(travelled_m(poses) if travelled is None else travelled, tiles.shape[1])[order]
        tile = flat[order]
        first = np.r_[True, tile[1:] != tile[:-1]]
        again = np.r_[False, way[1:] - way[:-1] > max(AWAY_M, 3 * spacing_m)] & ~first
        counted = np.cumsum(again)
        starts = np.flatnonzero(first)
        counted -= np.repeat(counted[starts], np.diff(np.r_[starts, len(tile)]))
        number = np.empty(len(flat), np.uint64)
        number[order] = np.minimum(counted, MOST)
        return cls(tiles, number.reshape(tiles.shape))

    @classmethod
    def each_scan(cls, poses: NDArray[np.float64], order: NDArray[np.int64] | None = None) -> "Passes":
        """Make every scan a pass of its own; scans that are ``MOST`` + 1 scans apart share a number.

        Args:
            poses: T_map_lidar of the scans in the order of the traversal (n, 4, 4).
            order: position of each scan in the whole traversal (n,); None if ``poses`` are the whole traversal.
        """
        tiles = cls.of(poses).tiles
        order = np.arange(len(poses)) if order is None else order
        number = order.astype(np.uint64)[:, None] % np.uint64(MOST + 1)
        return cls(tiles, np.broadcast_to(number, tiles.shape))

    def bits(self, scan: int, tiles: NDArray[np.int64]) -> NDArray[np.uint64]:
        """Return the bit of the scan's pass over each tile (m,); 0 for a tile out of reach.

        Args:
            scan: index of the scan.
            tiles: numbers of the tiles (m,).
        """
        at = np.minimum(np.searchsorted(self.tiles[scan], tiles), self.tiles.shape[1] - 1)
        bits = np.uint64(1) << self.number[scan][at]
        return np.where(self.tiles[scan][at] == tiles, bits, np.uint64(0))


def tile_of(positions: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the number of the tile of each position (n,).

    Args:
        positions: metres, map frame, (n, 2) or (n, 3).
    """
    return _numbered(np.floor(positions[:, :2] / TILE_M).astype(np.int64))


def tiles_within(numbers: NDArray[np.int64], position: NDArray[np.float64], reach_m: float) -> NDArray[np.bool_]:
    """Return whether some point of each tile is within reach of a position (n,).

    Args:
        numbers: numbers of the tiles, as from ``tile_of`` (n,).
        position: metres, map frame (2,).
        reach_m: largest distance, metres.
    """
    corner = (np.stack(np.divmod(numbers, _TILE_SPAN), axis=1) - _TILE_SPAN // 2) * TILE_M
    away = np.maximum(np.maximum(corner - position, position - corner - TILE_M), 0.0)
    return np.asarray((away**2).sum(axis=1) <= reach_m**2)


def _numbered(tiles: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.asarray((tiles[..., 0] + _TILE_SPAN // 2) * _TILE_SPAN + tiles[..., 1] + _TILE_SPAN // 2)


@dataclass(frozen=True, eq=False)
class Targets:
    """The voxels of a vote: those with a surface. A large map has millions of voxels, so each takes few bytes.

    Attributes:
        cloud: the voxel map. Voxels are named by their rows in ``VoxelMap.sums``. It must not change during the vote.
        has_surface: True for the voxels of the vote (N,).
        normals: unit normals of the surfaces, map frame; not set for other voxels (N, 3).
        numbers: numbers of the tiles that have voxels of the vote, ascending, as from ``tile_of`` (T,).
        tile: index of each voxel's tile in ``numbers``; not set for other voxels (N,).
        by_tile: rows of the voxels of the vote, sorted by tile (n,).
        first: first entry of each tile in ``by_tile`` (T + 1,).
    """

    cloud: VoxelMap
    has_surface: NDArray[np.bool_]
    normals: NDArray[np.float32]
    numbers: NDArray[np.int64]
    tile: NDArray[np.int32]
    by_tile: NDArray[np.int32]
    first: NDArray[np.int64]

    @classmethod
    def of(cls, cloud: VoxelMap) -> "Targets":
        """Select all voxels that have a surface.

        Args:
            cloud: the voxel map.
        """
        surfaces = cloud.surfaces()
        return cls.at(cloud, surfaces.rows, surfaces.normals)

    @classmethod
    def at(cls, cloud: VoxelMap, rows: NDArray[np.int32], normals: NDArray[np.float32]) -> "Targets":
        """Make the index by tile.

        Args:
            cloud: the voxel map, with N voxels.
            rows: rows of the voxels of the vote, ascending (n,).
            normals: unit normals, map frame (N, 3).
        """
        numbers, of_row = ranked(len(rows), lambda part: tile_of(cloud.means_of(rows[part])))
        order = np.argsort(of_row, kind="stable")
        first = np.searchsorted(of_row, np.arange(len(numbers) + 1), sorter=order)
        has_surface, tile = np.zeros(len(normals), np.bool_), np.empty(len(normals), np.int32)
        has_surface[rows], tile[rows] = True, of_row
        return cls(cloud, has_surface, normals, numbers, tile, rows[order], first)

    def of_tiles(self, numbers: NDArray[np.int64]) -> NDArray[np.int32]:
        """Return the rows of the voxels in some tiles (m,).

        Args:
            numbers: numbers of the tiles (K,).
        """
        found = _positions_in(self.numbers, numbers)
        ranges = [self.by_tile[self.first[k] : self.first[k + 1]] for k in found]
        return np.concatenate(ranges) if ranges else np.zeros(0, np.int32)

    def at_points(self, points_map: NDArray[np.float64]) -> NDArray[np.int32]:
        """Return the rows of the voxels that hold some of the points, ascending (m,). Points in other voxels are ignored.

        Args:
            points_map: metres, map frame (n, 3).

        Raises:
            DatasetError: a point lies beyond the reach of the voxel map.
        """
        rows = self.cloud.rows_of(points_map)
        return rows[self.has_surface[rows]]

    def numbers_of(self, rows: NDArray[np.integer[Any]]) -> NDArray[np.int64]:
        """Return the number of the tile of some voxels (m,).

        Args:
            rows: rows of the voxels (m,).
        """
        return np.asarray(self.numbers[self.tile[rows]])


def _positions_in(ascending: NDArray[np.int64], values: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the positions of those values that an ascending array contains (m,)."""
    at = np.searchsorted(ascending, values)
    inside = at < len(ascending)
    return np.asarray(at[inside][ascending[at[inside]] == values[inside]])


@dataclass(frozen=True, eq=False)
class Vote:
    """The setup of a vote.

    Attributes:
        targets: the voxels of the vote.
        cloud: the voxel map of all scans. It is not changed.
        dataset: the dataset with the scans.
        T_map_lidar: poses of the scans that vote, in the order of the traversal (n, 4, 4).
        numbers: indices of these scans in the dataset (n,).
        passes: the pass of each of these scans.
        settings: settings of the map: whether weather is removed.
        each_scan: every scan votes on its own, not with its pass. This finds traffic.
    """

    targets: Targets
    cloud: VoxelMap
    dataset: Dataset
    T_map_lidar: NDArray[np.float64]
    numbers: NDArray[np.int64]
    passes: Passes
    settings: BuildSettings
    each_scan: bool

    @classmethod
    def of(
        cls,
        cloud: VoxelMap,
        dataset: Dataset,
        poses: NDArray[np.float64],
        numbers: NDArray[np.int64],
        settings: BuildSettings,
        *,
        each_scan: bool,
        part: TilePart | None = None,
    ) -> "Vote":
        """Set up a vote.

        Args:
            cloud: the voxel map of all scans.
            dataset: the dataset with the scans.
            poses: T_map_lidar of all scans (N, 4, 4).
            numbers: indices of the scans that vote, in the order of the traversal (n,).
            settings: settings of the map: the spacing, and whether weather is removed.
            each_scan: every scan votes on its own.
            part: the part of the traversal that these scans are; None for all of it.
        """
        T_map_lidar = poses[numbers]
        order, travelled = (None, None) if part is None else (part.order, part.travelled_m)
        if each_scan:
            passes = Passes.each_scan(T_map_lidar, order)
        else:
            passes = Passes.of(T_map_lidar, spacing_m=settings.spacing_m, travelled=travelled)
        return cls(Targets.of(cloud), cloud, dataset, T_map_lidar, numbers, passes, settings, each_scan)

    def votes(self, scans: range, report: Callable[[int], None] = lambda _: None) -> Arrays:
        """Compute the votes of some scans. It reads them again, one at a time.

        Args:
            scans: rows of the scans in ``numbers``.
            report: called after every scan with its row plus one.

        Returns:
            ``of``: rows of the voxels that are hit or seen through (m,). ``hit`` and ``through``: a bit for each pass (m,).
        """
        targets, passes = self.targets, self.passes
        # Behind the voxel a ray must end farther away than this to see through it. Scans of one traversal agree better than passes.
        behind_m = (1 if self.each_scan else 2) * self.cloud.voxel_m
        hit, through = np.zeros((2, len(targets.normals)), np.uint64)
        for scan in scans:
            T = self.T_map_lidar[scan]
            points = clear_scan(self.dataset, int(self.numbers[scan]), self.settings)[:, :3].astype(np.float64)
            near = points.compress(lengths(points) <= REACH_M, axis=0)
            at = targets.at_points(transform_points(T, near))
            hit[at] |= passes.bits(scan, targets.numbers_of(at))
            tiles = passes.tiles[scan][tiles_within(passes.tiles[scan], T[:2, 3], REACH_M + _SLACK_M)]
            seen = looked_through(targets, targets.of_tiles(tiles), points, T, behind_m=behind_m)
            through[seen] |= passes.bits(scan, targets.numbers_of(seen))
            report(scan + 1)
        # By parts: a large map has no room for another array of all voxels.
        found = [part.start + np.flatnonzero(hit[part] | through[part]) for part in parts(len(hit))]
        of = np.concatenate([np.zeros(0, np.int64), *found])
        return {"of": of, "hit": hit[of], "through": through[of]}

    def removed(self, votes: Iterable[Arrays], earlier: NDArray[np.int64] | None = None) -> NDArray[np.int64]:
        """Count the votes; return the keys of the voxels that they remove, ascending (m,).

        A voxel is removed if at least two passes see through it, and more passes than hit it. With ``each_scan`` it is removed if the
        scans that see through it are not fewer than those that hit it.

        Args:
            votes: the votes of all scans, as ``votes`` returns them.
            earlier: keys of the voxels that were in the map before this survey (k,). The map counts as one more pass that hit them.
        """
        keys, _ = self.cloud.sums()
        hit, through = np.zeros((2, len(keys)), np.uint64)
        for part in votes:
            hit[part["of"]] |= part["hit"]
            through[part["of"]] |= part["through"]
        hits = np.maximum(np.bitwise_count(hit), 1)
        if earlier is not None:
            known = np.isin(keys, earlier)
            hits = np.where(known, np.bitwise_count(hit) + 1, hits)
        against = np.bitwise_count(through & ~hit)
        return np.asarray(keys[against >= hits if self.each_scan else against > hits])


def looked_through(
    targets: Targets,
    candidates: NDArray[np.int32],
    points: NDArray[np.float64],
    T_map_lidar: NDArray[np.float64],
    *,
    behind_m: float,
) -> NDArray[np.int32]:
    """Return the rows of the voxels that a scan sees through (m,).

    The scan becomes a range image with cells of half a degree, the nearest point in each. The scan sees through a voxel under three
    conditions:

    - The voxel's cell has a ray.
    - This ray and all rays of the eight cells around end far enough behind the voxel.
    - The end of this ray lies more than a voxel off the voxel's plane.

    Args:
        targets: the voxels.
        candidates: rows of the voxels to test (k,).
        points: points of the scan, metres, LiDAR frame (n, 3).
        T_map_lidar: pose of the scan (4, 4).
        behind_m: smallest distance between the voxel and the end of a ray behind it, metres. One hundredth of the range is added for
            errors of poses and beams.
    """
    points, candidates = np.ascontiguousarray(points), np.ascontiguousarray(candidates)
    keys, moments = targets.cloud.sums()
    origin, T_lidar_map = np.ascontiguousarray(targets.cloud.origin), np.ascontiguousarray(inverse(T_map_lidar)[:3])
    limits = np.array([_NEAREST_M, REACH_M, behind_m, targets.cloud.voxel_m])
    point_at, ranges, least = np.empty(_ROWS * _COLUMNS, np.int32), *np.empty((2, _ROWS * _COLUMNS))
    seen = np.empty(len(candidates), np.int32)
    count = _library().streetfix_looked_through(
        points.ctypes.data,
        len(points),
        keys.ctypes.data,
        moments.ctypes.data,
        origin.ctypes.data,
        targets.normals.ctypes.data,
        candidates.ctypes.data,
        len(candidates),
        T_lidar_map.ctypes.data,
        limits.ctypes.data,
        point_at.ctypes.data,
        least.ctypes.data,
        ranges.ctypes.data,
        seen.ctypes.data,
    )
    return seen[:count]
