"""Which tiles a camera sees from a position, and which of them gives a part of the cloud."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float64, Int8, Int64
from numpy.typing import NDArray

from service.maps.manifest import Tile
from service.registration.surfel_map import REGION_M, SurfelMap
from service.registration.surfel_tiles import AROUND_M, columns_of_regions, numbers_in_map


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
    nearest: Int64[NDArray[np.int64], " n"] = away.argmin(axis=1)
    return nearest


def tiles_around(
    number_of: Mapping[tuple[int, int], int],
    tile_m: float,
    xy_m: Float64[NDArray[np.float64], "n 2"],
    first: Int64[NDArray[np.int64], " n"],
) -> list[tuple[int, ...]]:
    """Return the tiles that own a region within ``AROUND_M`` along x and y of each position, by their numbers.

    Args:
        number_of: number of each tile of the map by column and row.
        tile_m: edge of the squares, m.
        xy_m: positions, map frame, m.
        first: number of the tile that comes first for each position, wherever it lies. The others follow by column and row.
    """
    low, high = (
        columns_of_regions(np.floor((xy_m + side) / REGION_M).astype(np.int64), tile_m)
        for side in (-AROUND_M, AROUND_M)
    )
    keys = [tuple(row) for row in np.column_stack([first, low, high]).tolist()]
    found: dict[tuple[int, ...], tuple[int, ...]] = {}
    for key in dict.fromkeys(keys):
        own, x0, y0, x1, y1 = key
        squares = ((x, y) for x in range(x0, x1 + 1) for y in range(y0, y1 + 1))
        others = (number_of[square] for square in squares if square in number_of)
        found[key] = (own, *(number for number in others if number != own))
    return [found[key] for key in keys]


def ranks_of_regions(cloud: SurfelMap, tile: Tile, tile_m: float) -> Int8[NDArray[np.int8], " R"]:
    """Return how a tile gives its regions to the map (``JoinedSurfels.of``): 2 for those that it owns, 1 for others with cells, else 0.

    A tile also has regions of squares without a tile. A merged map may have a tile there, which then goes first.

    Args:
        cloud: surfel map of the tile.
        tile: the tile.
        tile_m: edge of the squares, m.
    """
    owners = columns_of_regions(numbers_in_map(cloud)[:, :2], tile_m)
    is_own = (owners == (tile.column, tile.row)).all(axis=1)
    has_cells = np.diff(cloud.grid.regions["block"], append=len(cloud.grid.blocks)) > 0
    return np.where(is_own, np.int8(2), has_cells.astype(np.int8))
