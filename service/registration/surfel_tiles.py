"""The cloud of a tiled map: one surfel map for each tile. A pose is registered and rendered on the cloud of its own tile."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64
from numpy.typing import NDArray

from service.registration.kernel import TOLERANCE_M, QueryPoints, SolverOptions
from service.registration.surfel_map import SurfelMap

#: Largest number of tiles of a tiled map that a picture shows, evenly chosen. Each one is read from the disk.
DRAWN_TILES = 64


@dataclass(frozen=True, slots=True, eq=False)
class SurfelTiles:
    """Surfel maps of several tiles. The cloud of each tile reaches beyond its square, so a pose needs only one of them.

    Attributes:
        squares_m: x0, y0, x1, y1 of each tile, map frame, m.
        cloud_of: returns the surfel map of a tile by its row in ``squares_m``.
        origin_m: origin of the frame of the states that ``align`` registers, map frame, m.
        has_brightness: whether all tiles have intensities.
        drawn: returns the rows of the tiles that may be drawn. A tile that is still in its store would have to be fetched first.
    """

    squares_m: Float64[NDArray[np.float64], "T 4"]
    cloud_of: Callable[[int], SurfelMap]
    origin_m: Float64[NDArray[np.float64], "3"]
    has_brightness: bool
    drawn: Callable[[], Sequence[int]]

    def at(self, position_m: Float64[NDArray[np.float64], "3"]) -> SurfelMap:
        """Return the surfel map of the tile at a position, or of the nearest tile.

        Args:
            position_m: position, map frame, m.
        """
        return self.cloud_of(int(nearest_square(self.squares_m, position_m[None, :2])[0]))

    def parts(self, most: int) -> tuple[SurfelMap, ...]:
        """Return the surfel maps of some tiles to draw, evenly chosen. They overlap at the edges of their squares.

        Args:
            most: largest number of them.
        """
        rows = self.drawn()
        return tuple(self.cloud_of(row) for row in rows[:: max(1, -(-len(rows) // most))])

    def align(
        self,
        points: QueryPoints,
        states: NDArray[Any],
        options: SolverOptions,
        *,
        tolerance_m: float = TOLERANCE_M,
        height_min_m: float = -1e9,
    ) -> None:
        """Register every start on the cloud of its tile, in place, as ``SurfelMap.align``.

        Args:
            points: of the query.
            states: starts, (n,) of ``STATE``, relative to ``origin_m``; overwritten with the results.
            options: of the solver.
            tolerance_m: standard deviation of a point's distance to its surface in the score, m, apart from its noise.
            height_min_m: points lower than this do not count in the score, m.
        """
        tiles = nearest_square(self.squares_m, states["t"][:, :2] + self.origin_m[:2])
        for tile in np.unique(tiles):
            cloud, rows = self.cloud_of(int(tile)), np.flatnonzero(tiles == tile)
            some, moved_m = states[rows], self.origin_m - cloud.origin_m
            for name in ("t", "anchor"):
                some[name] += moved_m
            cloud.align(points, some, options, tolerance_m=tolerance_m, height_min_m=height_min_m)
            for name in ("t", "anchor"):
                some[name] -= moved_m
            states[rows] = some


#: The cloud of a map of one bundle or of a tiled map.
Cloud = SurfelMap | SurfelTiles


def nearest_square(
    squares_m: Float64[NDArray[np.float64], "T 4"], xy_m: Float64[NDArray[np.float64], "n 2"]
) -> Int64[NDArray[np.int64], " n"]:
    """Return the row of the square that holds each position, or of the nearest square.

    Args:
        squares_m: x0, y0, x1, y1 of each square, m.
        xy_m: positions, m.
    """
    low, high = squares_m[None, :, :2] - xy_m[:, None], xy_m[:, None] - squares_m[None, :, 2:]
    away = np.linalg.norm(np.maximum(np.maximum(low, high), 0.0), axis=2)
    nearest: NDArray[np.int64] = away.argmin(axis=1)
    return nearest
