"""The cloud of a tiled map: one surfel map for each tile. A pose is registered and rendered on those of the tiles around it, together."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int8, Int64
from numpy.typing import NDArray

from service.registration.kernel import (
    SURFEL,
    TOLERANCE_M,
    Piece,
    QueryPoints,
    SolverOptions,
    align,
    numbers_of_regions,
)
from service.registration.surfel_map import REGION_M, SurfelMap

#: Largest number of tiles of a tiled map that a picture shows, evenly chosen. Each one is read from the disk.
DRAWN_TILES = 64
#: A pose is registered and rendered on all surfels within this distance along x and y, m. Depth and map views end at 40 m
#: (``MAX_RANGE_M``), and the rendering of the map at a pose reads 45 m (``rendered_depth.REACH_M``).
AROUND_M = 50.0
#: Largest distance of a tile's grid from the lattice that all tiles share, as a part of a region.
_OFF_LATTICE = 1e-5


@dataclass(frozen=True, slots=True, eq=False)
class JoinedSurfels:
    """The surfels of several tiles together, as one map. Surfels are numbered tile by tile.

    Positions are relative to ``origin_m``, with the axes of the map frame.

    Attributes:
        origin_m: origin of the surfels' frame, map frame, m: that of the first tile.
        clouds: surfel maps of the tiles.
        pieces: what each of them gives, as the kernel takes it.
    """

    origin_m: Float64[NDArray[np.float64], "3"]
    clouds: tuple[SurfelMap, ...]
    pieces: tuple[Piece, ...]

    @classmethod
    def of(cls, clouds: Sequence[SurfelMap], ranks: Sequence[Int8[NDArray[np.int8], " _"]]) -> "JoinedSurfels":
        """Join surfel maps whose grids lie on one lattice (``lies_on_lattice``).

        Args:
            clouds: surfel maps, the first of which gives the frame.
            ranks: of each region of each map: 0 if the map does not give it. Otherwise the map with the highest rank gives a region, and of
                equal ranks the first map.
        """
        numbers = [numbers_in_map(cloud) for cloud in clouds]
        of_all, rank = np.concatenate(numbers), np.concatenate(ranks)
        order = np.flatnonzero(rank > 0)
        order = order[np.argsort(-rank[order], kind="stable")]  # the one that gives a region comes first
        _, first = np.unique(of_all[order], axis=0, return_index=True)
        serves = np.zeros(len(of_all), np.bool_)
        serves[order[first]] = True
        ends = np.cumsum([len(each) for each in numbers])[:-1]
        origin_m = clouds[0].origin_m
        pieces = tuple(
            Piece(cloud.grid, cloud.surfels, cloud.origin_m - origin_m, np.ascontiguousarray(served))
            for cloud, served in zip(clouds, np.split(serves, ends), strict=True)
        )
        return cls(origin_m, tuple(clouds), pieces)

    @property
    def has_brightness(self) -> bool:
        """Whether a tile has intensities."""
        return any(cloud.has_brightness for cloud in self.clouds)

    def unpacked(self, rows: NDArray[np.integer[Any]]) -> NDArray[Any]:
        """Return surfels as numbers: (n,) of ``SURFEL``, in the surfels' frame.

        Args:
            rows: numbers of surfels (n,).
        """
        found = np.empty(len(rows), SURFEL)
        for cloud, at, own in self._of_each(rows):
            found[at] = cloud.unpacked(own)
            found["xyz"][at] += (cloud.origin_m - self.origin_m).astype(np.float32)
        return found

    def brightness_of(self, rows: NDArray[np.integer[Any]]) -> Float32[NDArray[np.float32], " *n"] | None:
        """Return the intensities of some surfels in the sensor's unit, NaN where unknown; None if no tile has any.

        Args:
            rows: numbers of surfels, (n,) or of another shape, which the result has too.
        """
        if not self.has_brightness:
            return None
        found = np.full(rows.shape, np.nan, np.float32)
        for cloud, at, own in self._of_each(rows):
            if (values := cloud.brightness_of(own)) is not None:
                found[at] = values
        return found

    def _of_each(
        self, rows: NDArray[np.integer[Any]]
    ) -> list[tuple[SurfelMap, Bool[NDArray[np.bool_], " *n"], Int64[NDArray[np.int64], " m"]]]:
        """Return each tile that has some of the surfels, where they are in ``rows``, and their rows in the tile."""
        ends = np.cumsum([len(cloud.surfels) for cloud in self.clouds])
        of, found = np.searchsorted(ends, rows, side="right"), []
        for number, cloud in enumerate(self.clouds):
            at = of == number
            if at.any():
                found.append((cloud, at, rows[at].astype(np.int64) - (ends[number] - len(cloud.surfels))))
        return found


#: The surfels around a pose.
Surfels = SurfelMap | JoinedSurfels


@dataclass(frozen=True, slots=True, eq=False)
class SurfelTiles:
    """Surfel maps of several tiles. A pose gets those of all tiles around it.

    Attributes:
        tiles_near: returns the numbers of the tiles around each position, (n, 2), map frame, m. The tile at the position comes first.
        surfels_of: returns the surfels of some tiles together, by the numbers of the tiles.
        origin_m: origin of the frame of the states that ``align`` registers, map frame, m.
        has_brightness: whether all tiles have intensities.
        drawn: returns the numbers of the tiles that may be drawn. A tile that is still in its store would have to be fetched first.
        kept: surfels that ``surfels_of`` keeps, by the numbers of the tiles.
    """

    tiles_near: Callable[[Float64[NDArray[np.float64], "n 2"]], list[tuple[int, ...]]]
    surfels_of: Callable[[tuple[int, ...]], Surfels]
    origin_m: Float64[NDArray[np.float64], "3"]
    has_brightness: bool
    drawn: Callable[[], Sequence[int]]
    kept: Mapping[tuple[int, ...], Surfels] = field(default_factory=dict)

    def at(self, position_m: Float64[NDArray[np.float64], "3"]) -> Surfels:
        """Return the surfels around a position.

        Args:
            position_m: position, map frame, m.
        """
        return self.surfels_of(self.tiles_near(position_m[None, :2])[0])

    def parts(self, most: int) -> tuple[SurfelMap, ...]:
        """Return the surfel maps of some tiles to draw, evenly chosen. They overlap a little at the edges of their squares.

        Args:
            most: largest number of them.
        """
        numbers = self.drawn()
        chosen = (self.surfels_of((number,)) for number in numbers[:: max(1, -(-len(numbers) // most))])
        return tuple(each for each in chosen if isinstance(each, SurfelMap))

    def align(
        self,
        points: QueryPoints,
        states: NDArray[Any],
        options: SolverOptions,
        *,
        tolerance_m: float = TOLERANCE_M,
        height_min_m: float = -1e9,
    ) -> None:
        """Register every start on the surfels around it, in place, as ``SurfelMap.align``.

        Args:
            points: of the query.
            states: starts, (n,) of ``STATE``, relative to ``origin_m``; overwritten with the results.
            options: of the solver.
            tolerance_m: standard deviation of a point's distance to its surface in the score, m, apart from its noise.
            height_min_m: points lower than this do not count in the score, m.
        """
        near = self.tiles_near(states["t"][:, :2] + self.origin_m[:2])
        for numbers in dict.fromkeys(near):
            surfels = self.surfels_of(numbers)
            rows, moved_m = [k for k, each in enumerate(near) if each == numbers], self.origin_m - surfels.origin_m
            some = states[rows]
            for name in ("t", "anchor"):
                some[name] += moved_m
            align(surfels.pieces, points, some, options, tolerance_m=tolerance_m, height_min_m=height_min_m)
            for name in ("t", "anchor"):
                some[name] -= moved_m
            states[rows] = some


#: The cloud of a map of one bundle or of a tiled map.
Cloud = SurfelMap | SurfelTiles


def lies_on_lattice(cloud: SurfelMap) -> bool:
    """Return whether the corner of a surfel map's grid is a whole number of regions away from the origin of the map frame.

    Args:
        cloud: surfel map of a tile.
    """
    regions = _corner_in_regions(cloud)
    return cloud.grid.region_m == REGION_M and bool((np.abs(regions - np.rint(regions)) < _OFF_LATTICE).all())


def numbers_in_map(cloud: SurfelMap) -> Int64[NDArray[np.int64], "R 3"]:
    """Return the numbers of a surfel map's regions along x, y and z, counted from the origin of the map frame.

    Args:
        cloud: surfel map of a tile, which lies on the lattice.
    """
    return np.rint(_corner_in_regions(cloud)).astype(np.int64) + numbers_of_regions(cloud.grid.regions["key"])


def _corner_in_regions(cloud: SurfelMap) -> Float64[NDArray[np.float64], "3"]:
    corner: Float64[NDArray[np.float64], 3] = (cloud.origin_m + cloud.grid.origin_m) / REGION_M
    return corner


def columns_of_regions(numbers: Int64[NDArray[np.int64], " *n"], tile_m: float) -> Int64[NDArray[np.int64], " *n"]:
    """Return the columns (or rows) of the tiles whose squares hold the centres of some regions. These tiles own the regions.

    Args:
        numbers: numbers of regions along x (or y), counted from the origin of the map frame.
        tile_m: edge of the squares, m.
    """
    columns: Int64[NDArray[np.int64], " *n"] = np.floor((numbers + 0.5) * REGION_M / tile_m).astype(np.int64)
    return columns


def first_region(column: int, tile_m: float) -> int:
    """Return the number of the first region along x (or y) that a tile owns. The last one comes before that of the next column.

    Args:
        column: column (or row) of the tile.
        tile_m: edge of the squares, m.
    """

    def owner(number: int) -> int:
        return int(columns_of_regions(np.array([number]), tile_m)[0])

    number = math.ceil(column * tile_m / REGION_M - 0.5)
    # The quotient is rounded. ``columns_of_regions`` decides.
    while owner(number - 1) >= column:
        number -= 1
    while owner(number) < column:
        number += 1
    return number
