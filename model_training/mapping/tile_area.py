"""The ground that a tile covers. Tiles share the cloud of a map among each other, so each surface is stored once.

The lookup grids of all tiles lie on one lattice of regions (``surfel_map.REGION_M``), and a tile owns the regions whose centres are in its
square. Its cloud has

- the regions that it owns,
- the regions of squares without a tile that begin within ``TILE_MARGIN_M`` of its square, because no tile owns them,
- and ``overlap_m`` more on all sides, because a cell at the edge of a region may be nearest to a surfel behind the edge.

A query near an edge uses the clouds of all tiles around it (decision 0199).
"""

import math
from collections.abc import Set
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model_training.mapping.cloud import CLOUD_REACH_M
from service.registration.surfel_map import CELL_M, REACH_M, REGION_M, SurfelMap
from service.registration.surfel_tiles import AROUND_M, columns_of_regions, first_region

#: How far the cloud of a tile reaches beyond its square where no other tile is, metres: as far as a query is registered.
TILE_MARGIN_M = AROUND_M
#: A place is surrounded by the cloud of its tile if all surfaces up to this distance are in it, metres.
SURROUNDING_M = 45.0


def overlap_m(voxel_m: float) -> float:
    """Return how far the cloud of a tile reaches beyond its own regions where another tile is, metres.

    The centre of a cell is at least half an edge inside its region. Its surfel needs its own voxel, and for the normal the voxels around.

    Args:
        voxel_m: edge of the cloud's voxels, metres.
    """
    return REACH_M - CELL_M / 2 + 2 * voxel_m


def cloud_margin_m(voxel_m: float) -> float:
    """Return how far the cloud of a tile reaches beyond its square at most, metres.

    Args:
        voxel_m: edge of the cloud's voxels, metres.
    """
    return TILE_MARGIN_M + REGION_M + overlap_m(voxel_m)


@dataclass(frozen=True, slots=True, order=True)
class Square:
    """A square of the ground.

    Attributes:
        column: it has the positions with ``column * tile_m <= x < (column + 1) * tile_m``, map frame, metres.
        row: the same for y.
        tile_m: edge, metres.
    """

    column: int
    row: int
    tile_m: float

    def within(self, margin_m: float, positions: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return whether each position is in the square or at most a margin beside it (n,).

        Args:
            margin_m: margin on all four sides, metres.
            positions: metres, map frame (n, 2) or (n, 3).
        """
        return self.ground.wider(margin_m).contains(positions)

    @property
    def ground(self) -> "_Box":
        """The square itself."""
        x0, y0, x1, y1 = (number * self.tile_m for number in (self.column, self.row, self.column + 1, self.row + 1))
        return _Box(x0, y0, x1, y1)

    @property
    def regions(self) -> "_Box":
        """The regions that a tile of this square owns."""
        x, y = self.column, self.row
        first = [first_region(each, self.tile_m) * REGION_M for each in (x, y, x + 1, y + 1)]
        return _Box(*first)


@dataclass(frozen=True, slots=True)
class _Box:
    """A rectangle on the ground: x0, y0 and, excluded, x1, y1, metres, map frame."""

    x0: float
    y0: float
    x1: float
    y1: float

    def contains(self, positions: NDArray[np.float64]) -> NDArray[np.bool_]:
        x, y = positions[:, 0], positions[:, 1]
        return np.asarray((x >= self.x0) & (x < self.x1) & (y >= self.y0) & (y < self.y1))

    def wider(self, by_m: float) -> "_Box":
        return _Box(self.x0 - by_m, self.y0 - by_m, self.x1 + by_m, self.y1 + by_m)

    def within(self, other: "_Box") -> "_Box":
        return _Box(max(self.x0, other.x0), max(self.y0, other.y0), min(self.x1, other.x1), min(self.y1, other.y1))

    def in_whole_regions(self) -> "_Box":
        """Return the smallest rectangle of whole regions around this one."""
        low, high = (
            (math.floor(each / REGION_M) * REGION_M for each in (self.x0, self.y0)),
            (math.ceil(each / REGION_M) * REGION_M for each in (self.x1, self.y1)),
        )
        return _Box(*low, *high)

    def away_m(self, positions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Distances along x and y of positions (n, 2 or more) from the rectangle (n, 2); 0 inside."""
        x, y = positions[:, 0], positions[:, 1]
        beside = [np.maximum(self.x0 - x, x - self.x1), np.maximum(self.y0 - y, y - self.y1)]
        return np.asarray(np.maximum(np.stack(beside, axis=1), 0.0))


class TileArea:
    """The ground that a tile covers.

    Args:
        square: square of the tile.
        squares: columns and rows of all squares of the map that have a tile, this one included or not.
        voxel_m: edge of the cloud's voxels, metres.

    Attributes:
        square: square of the tile.
        beside: columns and rows of the other squares with a tile around it, ascending.
    """

    def __init__(self, square: Square, squares: Set[tuple[int, int]], voxel_m: float) -> None:
        self.square, self._overlap_m = square, overlap_m(voxel_m)
        reach = math.ceil((TILE_MARGIN_M + 2 * REGION_M) / square.tile_m)
        around = [
            Square(square.column + x, square.row + y, square.tile_m)
            for x in range(-reach, reach + 1)
            for y in range(-reach, reach + 1)
            if x or y
        ]
        others = [each for each in around if (each.column, each.row) in squares]
        self.beside = tuple(sorted((each.column, each.row) for each in others))
        self._others = tuple(each.regions for each in others)
        # Whole regions, so that all tiles with a region have all of it.
        self._reached = square.ground.wider(TILE_MARGIN_M).in_whole_regions()
        free = (each.regions.within(self._reached) for each in around if each not in others)
        boxes = (square.regions, *(box for box in free if box.x0 < box.x1 and box.y0 < box.y1))
        self._boxes = tuple(box.wider(self._overlap_m) for box in boxes)

    def is_in_cloud(self, positions: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return whether the cloud of the tile has each point (n,).

        Args:
            positions: metres, map frame (n, 3).
        """
        inside = self._boxes[0].contains(positions)
        for box in self._boxes[1:] if not inside.all() else ():
            inside |= box.contains(positions)
        return inside

    def reads(self, positions: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return whether a scan at each position may have points in the cloud (n,).

        Args:
            positions: metres, map frame (n, 2) or (n, 3).
        """
        found = np.zeros(len(positions), np.bool_)
        for box in self._boxes:
            found |= np.hypot(*box.away_m(positions).T) < CLOUD_REACH_M
        return found

    def has_cells(self, centres: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return whether the tile has the cells of each region (n,): its own regions, and those that no tile owns.

        Args:
            centres: centres of regions, metres, map frame (n, 3).
        """
        owners = columns_of_regions(np.floor(centres[:, :2] / REGION_M).astype(np.int64), self.square.tile_m)
        others = set(self.beside)
        is_free = np.array([owner not in others for owner in map(tuple, owners.tolist())], np.bool_)
        return np.asarray(is_free & (self.square.regions.contains(centres) | self._reached.contains(centres)))

    def may_share(self, square: tuple[int, int]) -> bool:
        """Return whether the cloud of another tile may reach into this one.

        Args:
            square: column and row of the other tile.
        """
        away = max(abs(square[0] - self.square.column), abs(square[1] - self.square.row)) - 1
        return away * self.square.tile_m < 2 * (TILE_MARGIN_M + REGION_M + self._overlap_m)

    def surrounds(self, positions: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return whether the cloud of the tile alone has all surfaces up to ``SURROUNDING_M`` around each position of its square (n,).

        Args:
            positions: metres, map frame (n, 2) or (n, 3).
        """
        found = np.ones(len(positions), np.bool_)
        for box in self._others:
            found &= (box.away_m(positions) >= SURROUNDING_M - self._overlap_m).any(axis=1)
        return found


def cloud_of_tile(cloud: SurfelMap, area: TileArea) -> SurfelMap:
    """Return what a tile has of the cloud of a map of one bundle.

    Args:
        cloud: cloud of the map.
        area: the ground that the tile covers.
    """
    surfels, origin_m = cloud.unpacked(slice(None)), cloud.origin_m
    inside = area.is_in_cloud(surfels["xyz"] + origin_m)
    brightness = cloud.brightness_of(np.flatnonzero(inside))
    packed = SurfelMap.packed(surfels[inside], brightness, -origin_m)
    return SurfelMap.of_packed(origin_m, *packed, lambda centres: area.has_cells(centres + origin_m))
