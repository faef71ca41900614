"""What moved between the passes of a survey: voxels that more passes look through than hit.

Ours, after the visibility tests of map cleaning (for example Kim and Kim, "Remove, then Revert", IROS 2020), with two guards: a pass
that hits a voxel anywhere has no vote against it, so a thin pole that most rays miss stays; and a ray that ends on the voxel's own
plane, as rays along the ground and along walls do, has not looked through it.

Traffic is found in the same way where every scan votes for itself: what drives on before the vehicle is hit once and looked through by
the scans after it, what stands is hit again.

Passes count per tile of the ground: a tile that comes into reach again after some way elsewhere is passed again. Who turns round
within reach is still on the same pass. Votes are bits, one a pass, so that they add up in any order.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from model_training.datasets.dataset import Dataset
from model_training.mapping.settings import BuildSettings
from model_training.mapping.survey import clear_scan, travelled_m
from model_training.mapping.voxel_map import VoxelMap
from model_training.mapping.work import Arrays, Work
from service.geometry.rigid import inverse, transform_points

TILE_M = 10.0
REACH_M = 30.0  # beyond it a beam is wider than what it should look past
AWAY_M = 30.0  # of travel out of a tile's reach: then the next visit is another pass
MOST = 63  # passes that are told apart; later ones count as the last
CHUNK = 64  # scans

_CELL_DEG = 0.5
_ROWS, _COLUMNS = 180, 720  # -45 to 45 degrees, all round
_NEAREST_M = 2.0  # the vehicle itself
_SPAN = 1 << 24
Report = Callable[[str, int, int], None]


@dataclass(frozen=True, eq=False)
class Passes:
    """Which pass over each tile in reach a scan belongs to.

    Attributes:
        tiles: of each scan (n, K), as ``tile_of`` numbers them, rising.
        number: of the pass over that tile (n, K), 0 to ``MOST``.
    """

    tiles: NDArray[np.int64]
    number: NDArray[np.uint64]

    @classmethod
    def of(cls, poses: NDArray[np.float64], *, spacing_m: float = 1.0) -> "Passes":
        """Of the scans' poses (n, 4, 4) in the order of the drive; those of one pass stand about ``spacing_m`` apart."""
        half = int(np.ceil(REACH_M / TILE_M)) + 1
        steps = np.arange(-half, half + 1)
        around = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
        # A tile's furthest corner from any point of the middle one still counts: who is in reach has its tile here.
        around = around[(np.maximum(np.abs(around) - 1, 0) ** 2).sum(axis=1) * TILE_M**2 <= REACH_M**2]
        tiles = np.sort(_numbered(np.floor(poses[:, None, :2, 3] / TILE_M).astype(np.int64) + around), axis=1)
        flat = tiles.ravel()
        order = np.argsort(flat, kind="stable")  # by tile, and in the order of the drive
        way = np.repeat(travelled_m(poses), tiles.shape[1])[order]
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
    def each_scan(cls, poses: NDArray[np.float64]) -> "Passes":
        """Every scan a pass of its own, by the bits there are: those ``MOST`` + 1 scans apart share one."""
        tiles = cls.of(poses).tiles
        number = np.arange(len(poses), dtype=np.uint64)[:, None] % np.uint64(MOST + 1)
        return cls(tiles, np.broadcast_to(number, tiles.shape))

    def bits(self, scan: int, tiles: NDArray[np.int64]) -> NDArray[np.uint64]:
        """The bit of a scan's pass over each of some tiles; 0 where it is out of reach."""
        at = np.minimum(np.searchsorted(self.tiles[scan], tiles), self.tiles.shape[1] - 1)
        bits = np.uint64(1) << self.number[scan][at]
        return np.where(self.tiles[scan][at] == tiles, bits, np.uint64(0))


def tile_of(positions: NDArray[np.float64]) -> NDArray[np.int64]:
    """Number of the tile that each position (n, 2 or 3), metres, map frame, lies in."""
    return _numbered(np.floor(positions[:, :2] / TILE_M).astype(np.int64))


def _numbered(tiles: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.asarray((tiles[..., 0] + _SPAN // 2) * _SPAN + tiles[..., 1] + _SPAN // 2)


@dataclass(frozen=True, eq=False)
class Targets:
    """Voxels that are voted about, sorted by tile.

    Attributes:
        keys: of the voxels (n), in the order of ``VoxelMap.sums``: rising.
        positions: of their surfels (n, 3), metres, map frame.
        normals: of their surfels (n, 3).
        tile: of each (n).
        by_tile: numbers of the voxels, tile by tile (n).
        voxel_m: edge of a voxel.
    """

    keys: NDArray[np.int64]
    positions: NDArray[np.float64]
    normals: NDArray[np.float32]
    tile: NDArray[np.int64]
    by_tile: NDArray[np.int64]
    voxel_m: float

    @classmethod
    def of(cls, cloud: VoxelMap) -> "Targets":
        """All voxels that become surfels."""
        surfels = cloud.surfels()
        tile = tile_of(surfels.positions)
        return cls(
            surfels.keys, surfels.positions, surfels.normals, tile, np.argsort(tile, kind="stable"), cloud.voxel_m
        )

    def of_tiles(self, tiles: NDArray[np.int64]) -> NDArray[np.int64]:
        """Numbers of the voxels in some tiles."""
        first = np.searchsorted(self.tile, tiles, side="left", sorter=self.by_tile)
        last = np.searchsorted(self.tile, tiles, side="right", sorter=self.by_tile)
        ranges = [self.by_tile[a:b] for a, b in zip(first, last, strict=True)]
        return np.concatenate(ranges) if ranges else np.zeros(0, np.int64)


def moved(
    cloud: VoxelMap, dataset: Dataset, poses: NDArray[np.float64], numbers: NDArray[np.int64], settings: BuildSettings, work: Work, *,
    earlier: NDArray[np.int64] | None = None, each_scan: bool = False, report: Report = lambda *_: None,
) -> NDArray[np.int64]:  # fmt: skip
    """Keys of the voxels that more passes look through than hit, two at least; of scans, as many as hit.

    Reads the scans once more, one at a time.

    Args:
        cloud: of all the scans; it is not changed.
        dataset: with the scans.
        poses: T_map_lidar of all scans (N, 4, 4).
        numbers: of the scans that vote, in the order of the drive.
        settings: the spacing, and whether weather is removed.
        work: keeps the votes of finished scans.
        earlier: keys of voxels that were in the map before this survey, which counts as one more pass that hit them.
        each_scan: every scan votes for itself, which finds traffic, instead of with all of its pass.
        report: told after every scan.
    """
    targets = Targets.of(cloud)
    drive = poses[numbers]
    passes = Passes.each_scan(drive) if each_scan else Passes.of(drive, spacing_m=settings.spacing_m)
    ballot = Ballot(targets, passes, behind_m=(1 if each_scan else 2) * cloud.voxel_m)
    kind, stage = ("traffic", "traffic") if each_scan else ("votes", "passes")

    def told(done: int) -> None:
        report(stage, done, len(numbers))

    hit, through = np.zeros(len(targets.keys), np.uint64), np.zeros(len(targets.keys), np.uint64)
    for first in range(0, len(numbers), CHUNK):
        scans = range(first, min(first + CHUNK, len(numbers)))
        make = partial(_votes, ballot, cloud, dataset, poses, numbers, settings, scans, told)
        votes = work.part(f"{kind}-{first:07d}", make)
        hit[votes["of"]] |= votes["hit"]
        through[votes["of"]] |= votes["through"]
        told(scans.stop)
    hits = np.maximum(np.bitwise_count(hit), 1).astype(np.int64)
    if earlier is not None:
        known = np.isin(targets.keys, earlier)
        hits = np.where(known, np.bitwise_count(hit) + 1, hits)
    against = np.bitwise_count(through & ~hit).astype(np.int64)
    return np.asarray(targets.keys[against >= hits if each_scan else against > hits])


@dataclass(frozen=True, eq=False)
class Ballot:
    """What is voted about, who has a vote, and how far behind a voxel a ray must end to have looked through it."""

    targets: Targets
    passes: Passes
    behind_m: float


def _votes(
    ballot: Ballot, cloud: VoxelMap, dataset: Dataset, poses: NDArray[np.float64], numbers: NDArray[np.int64],
    settings: BuildSettings, scans: range, told: Callable[[int], None],
) -> Arrays:  # fmt: skip
    targets, passes = ballot.targets, ballot.passes
    hit, through = np.zeros(len(targets.keys), np.uint64), np.zeros(len(targets.keys), np.uint64)
    for scan in scans:
        T = poses[numbers[scan]]
        points = clear_scan(dataset, int(numbers[scan]), settings)[:, :3].astype(np.float64)
        near = points[np.linalg.norm(points, axis=1) <= REACH_M]
        touched = np.unique(cloud.keys_of(transform_points(T, near)))
        at = np.searchsorted(targets.keys, touched)
        inside = at < len(targets.keys)
        at = at[inside][targets.keys[at[inside]] == touched[inside]]
        hit[at] |= passes.bits(scan, targets.tile[at])
        seen = looked_through(targets, targets.of_tiles(passes.tiles[scan]), points, T, behind_m=ballot.behind_m)
        through[seen] |= passes.bits(scan, targets.tile[seen])
        told(scan + 1)
    of = np.flatnonzero(hit | through)
    return {"of": of, "hit": hit[of], "through": through[of]}


def looked_through(
    targets: Targets, candidates: NDArray[np.int64], points: NDArray[np.float64], T_map_lidar: NDArray[np.float64], *, behind_m: float
) -> NDArray[np.int64]:  # fmt: skip
    """Those of some voxels that a scan looks through.

    The scan is drawn all round in cells of half a degree, the nearest point in each. A voxel is looked through where a ray goes its
    way, this one and all in the cells around end far enough behind it, and this one leaves the voxel's plane.

    Args:
        targets: the voxels.
        candidates: numbers of those to look at.
        points: of the scan (n, 3), LiDAR frame.
        T_map_lidar: where it was taken.
        behind_m: how far is far enough, and a hundredth of the range more, for what poses and beams are off.
    """
    if not len(points):  # a scan without a single return looks through nothing
        return candidates[:0]
    ranges = np.linalg.norm(points, axis=1)
    cells, on_grid = _cells(points, ranges)
    order = np.flatnonzero(on_grid)
    order = order[np.argsort(-ranges[order], kind="stable")]  # the nearest is written last
    point_at = np.full(_ROWS * _COLUMNS, -1)
    point_at[cells[order]] = order
    nearest = np.where(point_at >= 0, ranges[point_at], np.inf).reshape(_ROWS, _COLUMNS)
    above = np.pad(nearest, ((1, 1), (0, 0)), constant_values=np.inf)
    rows = np.minimum(np.minimum(above[:-2], above[1:-1]), above[2:])
    around = np.minimum(np.minimum(np.roll(rows, 1, axis=1), rows), np.roll(rows, -1, axis=1)).ravel()
    T_lidar_map = inverse(T_map_lidar)
    position = transform_points(T_lidar_map, targets.positions[candidates])
    away = np.linalg.norm(position, axis=1)
    cell, visible = _cells(position, away)
    visible &= (away <= REACH_M) & (point_at[cell] >= 0)
    visible[visible] = around[cell[visible]] >= away[visible] * 1.01 + behind_m
    candidates, position, end = candidates[visible], position[visible], points[point_at[cell[visible]]]
    normal = targets.normals[candidates] @ T_lidar_map[:3, :3].T
    off_plane = np.abs(((end - position) * normal).sum(axis=1)) > targets.voxel_m
    return np.asarray(candidates[off_plane])


def _cells(points: NDArray[np.float64], ranges: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Cell of each direction, 0 where there is none, and whether there is."""
    elevation = np.rad2deg(np.arcsin(np.clip(points[:, 2] / np.maximum(ranges, 1e-9), -1, 1)))
    row = np.floor((elevation + 45.0) / _CELL_DEG).astype(np.int64)
    column = (
        np.floor((np.rad2deg(np.arctan2(points[:, 1], points[:, 0])) + 180.0) / _CELL_DEG).astype(np.int64) % _COLUMNS
    )
    inside = (row >= 0) & (row < _ROWS) & (ranges > _NEAREST_M)
    return np.where(inside, row * _COLUMNS + column, 0), inside
