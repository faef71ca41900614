"""Divide a survey into the tiles of a map: squares of the ground in the map frame.

The given poses decide, before anything is aligned. So each kept scan is in exactly one square, and the tiles do not depend on each
other. A place between two scans is in the square of its interpolated position.

A tile has the places of its square. It reads all scans that measure its cloud (``tile_area``). So no surface of the cloud lacks a scan.
"""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model_training.mapping.between import PlannedPlaces
from model_training.mapping.cloud import CLOUD_REACH_M
from model_training.mapping.survey import travelled_m
from model_training.mapping.tile_area import Square, TileArea, cloud_margin_m
from service.errors import DatasetError
from service.maps.manifest import LARGEST_TILE_M, MOST_TILES, SMALLEST_TILE_M


@dataclass(frozen=True, slots=True, eq=False)
class TilePart:
    """The part of a survey that becomes a tile. Its K scans are all kept scans with points in the cloud, and those of its places.

    Attributes:
        area: the ground that the tile covers.
        plan: places of the tile, by the index of the scan in the part.
        order: index of each scan among all kept scans (K,).
        travelled_m: travelled distance from the first kept scan of the survey to each scan, metres (K,).
        survey_scans: number of scans of the survey in the square, kept or not.
    """

    area: TileArea
    plan: PlannedPlaces
    order: NDArray[np.int64]
    travelled_m: NDArray[np.float64]
    survey_scans: int

    @property
    def square(self) -> Square:
        """The square of the tile."""
        return self.area.square


def require_tile_edge(tile_m: float) -> None:
    """Refuse an edge that the format does not allow.

    Args:
        tile_m: edge of the tiles, metres.

    Raises:
        DatasetError: the edge is too small, too large or not a number.
    """
    if not (math.isfinite(tile_m) and SMALLEST_TILE_M <= tile_m <= LARGEST_TILE_M):
        raise DatasetError(
            f"tile_m: {tile_m:g} is not valid; give {SMALLEST_TILE_M:g} to {LARGEST_TILE_M:,.0f} metres", field="tile_m"
        )


def columns_and_rows(positions: NDArray[np.float64], tile_m: float) -> NDArray[np.int64]:
    """Return the column and the row of the square of each position (n, 2).

    Args:
        positions: metres, map frame (n, 2) or (n, 3).
        tile_m: edge of the squares, metres.

    Raises:
        DatasetError: a position is too far from the origin of the map frame.
    """
    xy = positions[:, :2]
    found = np.floor(xy / tile_m)
    # The quotient is rounded. The products with the edge decide, as in the format.
    found -= xy < found * tile_m
    found += xy >= (found + 1) * tile_m
    if len(found) and np.abs(found).max() >= MOST_TILES:
        farthest = int(np.abs(found).max(axis=1).argmax())
        raise DatasetError(
            f"survey/poses.txt: {np.round(xy[farthest]).tolist()} m is more than {MOST_TILES:,} tiles from the origin of the map frame; "
            "subtract an offset from all poses, or give a larger --tile-m",
            field="poses",
        )
    return np.asarray(found.astype(np.int64))


def tile_parts(
    poses: NDArray[np.float64],
    kept: NDArray[np.int64],
    *,
    tile_m: float,
    between_m: float,
    voxel_m: float,
    also: Iterable[tuple[int, int]] = (),
) -> Iterator[TilePart]:
    """Yield the tiles of a survey that have a place, by column and row.

    Args:
        poses: given T_map_lidar of all scans of the survey (n, 4, 4).
        kept: indices of the kept scans, ascending (P,).
        tile_m: edge of the tiles, metres.
        between_m: largest distance between two places, metres; 0 puts none between scans.
        voxel_m: edge of the cloud's voxels, metres.
        also: columns and rows of other squares that have a tile. They are yielded without a place too, and their parts may have no scan.

    Raises:
        DatasetError: a pose is too far from the origin of the map frame.
    """
    T = poses[kept]
    xy, travelled = T[:, :2, 3], travelled_m(T)
    of_scan = columns_and_rows(xy, tile_m)
    scans_in = _grouped(of_scan)
    later, share = _on_way(T, between_m)
    of_way = columns_and_rows(places_xy(T, between_m)[len(T) :], tile_m)
    ways_in = _grouped(of_way)
    given_in = {square: len(found) for square, found in _grouped(columns_and_rows(poses[:, :3, 3], tile_m)).items()}
    reach = math.ceil((cloud_margin_m(voxel_m) + CLOUD_REACH_M) / tile_m)  # farther scans have no point in the cloud
    around = range(-reach, reach + 1)
    none = np.zeros(0, np.int64)
    squares = scans_in.keys() | ways_in.keys() | set(also)
    for column, row in sorted(squares):
        area, ways = TileArea(Square(column, row, tile_m), squares, voxel_m), ways_in.get((column, row), none)
        near = np.sort(np.concatenate([scans_in.get((column + x, row + y), none) for x in around for y in around]))
        # A place on the way beyond the end of a traversal may have its two scans farther away than the cloud reaches.
        order = np.unique(np.concatenate([near[area.reads(xy[near])], later[ways] - 1, later[ways]]))
        on_way: dict[int, tuple[float, ...]] = {}
        for way in ways:
            k = int(np.searchsorted(order, later[way]))
            on_way[k] = (*on_way.get(k, ()), float(share[way]))
        at_scan = (of_scan[order] == (column, row)).all(axis=1)
        yield TilePart(area, PlannedPlaces(at_scan, on_way), order, travelled[order], given_in.get((column, row), 0))


def places_xy(T_map_lidar: NDArray[np.float64], between_m: float) -> NDArray[np.float64]:
    """Return where a traversal gets its places: at its kept scans, then between distant ones, metres, map frame (P, 2).

    Args:
        T_map_lidar: poses of the kept scans in the order of the traversal (n, 4, 4).
        between_m: largest distance between two places, metres; 0 puts none between scans.
    """
    xy = T_map_lidar[:, :2, 3]
    later, share = _on_way(T_map_lidar, between_m)
    return np.concatenate([xy, (1 - share)[:, None] * xy[later - 1] + share[:, None] * xy[later]])


def _grouped(squares: NDArray[np.int64]) -> dict[tuple[int, int], NDArray[np.int64]]:
    """Return the rows of each square, ascending, by column and row."""
    if not len(squares):
        return {}
    found, of = np.unique(squares, axis=0, return_inverse=True)
    by_square = np.argsort(of.ravel(), kind="stable")
    ends = np.cumsum(np.bincount(of.ravel()))[:-1]
    parts = np.split(by_square, ends)
    return {(int(column), int(row)): part for (column, row), part in zip(found, parts, strict=True)}


def _on_way(T: NDArray[np.float64], between_m: float) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the places between kept scans: index of the later scan (W,) and share of the way (W,), in their order."""
    plan = PlannedPlaces.of(T, between_m).on_way
    later = np.array([k for k, shares in plan.items() for _ in shares], np.int64)
    return later, np.array([share for shares in plan.values() for share in shares], np.float64)
