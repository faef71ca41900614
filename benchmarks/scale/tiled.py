"""Search without a prior as a tiled map does it, in drawn maps.

``TiledMap.searched`` chooses six tiles and puts them together. ``search_views`` scans the coarse copy of each tile and compares the listed
views exactly. Only the tiles are drawn instead of read from files.
"""

import time
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Int8
from numpy.typing import NDArray

from benchmarks.scale.drawn import Asked, DrawnViews
from benchmarks.scale.sources import HEADINGS
from service.imaging.view_grid import ViewGrid
from service.maps.content import PLACE, VIEW
from service.maps.index import ViewIndex
from service.maps.joined_index import JoinedShortlists
from service.maps.manifest import Counts, Manifest
from service.maps.map import Map
from service.maps.tiles import OpenTiles, PlaceSearch, TiledMap
from service.retrieval.hypotheses import ClusterSettings
from service.retrieval.knn import search_views
from service.retrieval.retrieve import RANKED

#: Best views that count for recall.
BEST = 10
#: Rounds over the queries. A time is the median over the queries of each one's least processor time.
ROUNDS = 3
#: Queries whose tiles are drawn together, outside of the timed part, and tiles that stay in memory, each with 40 MB. Drawing takes seconds.
BATCH, KEPT_TILES = 6, 90
#: Views that are drawn at once, because drawing needs sixteen times the memory.
_CHUNK = 16_384


@dataclass(frozen=True, slots=True)
class TiledSearch:
    """Measured searches of a tiled map.

    Attributes:
        ms: processor time of a search, ms.
        choose_ms: part of it in which the tiles are chosen and put together, ms.
        compare_ms: part of it in which the tiles are scanned and the listed views compared, ms.
        recall: share of the ten best views of the whole map that a search finds.
    """

    ms: float
    choose_ms: float
    compare_ms: float
    recall: float


@dataclass(frozen=True, slots=True, eq=False)
class _DrawnTile:
    """What a search reads of an open tile."""

    places: NDArray[Any]
    views: NDArray[Any]
    view_index: ViewIndex


class DrawnTiles(OpenTiles):
    """Tiles of a drawn map, each drawn when it is needed. The least recently used ones are forgotten.

    Args:
        numbers: descriptors of the map.
        tile_views: number of views of a tile; the last tile may have fewer.

    Attributes:
        first_view: number of the first view of each tile, and the number of all views.
    """

    def __init__(self, numbers: DrawnViews, tile_views: int) -> None:
        self._numbers = numbers
        self.first_view = np.append(np.arange(0, len(numbers), tile_views), len(numbers))
        self.first_place = -(-self.first_view // HEADINGS)
        self._drawn: OrderedDict[int, _DrawnTile] = OrderedDict()
        self._last: tuple[tuple[int, ...], Map] | None = None

    def __len__(self) -> int:
        """Return the number of tiles."""
        return len(self.first_view) - 1

    def get_all(self, numbers: Sequence[int]) -> list[Any]:
        """Return several tiles, drawn one after another.

        Args:
            numbers: numbers of the tiles.
        """
        return [self.get(number) for number in numbers]

    def get(self, number: int) -> Any:
        """Return a tile.

        Args:
            number: number of the tile.
        """
        if number not in self._drawn:
            descriptors = kept(self._numbers, int(self.first_view[number]), int(self.first_view[number + 1]))
            views = np.zeros(len(descriptors), VIEW)
            views["place"] = np.arange(len(descriptors)) // HEADINGS
            places = np.zeros(int(views["place"][-1]) + 1, PLACE)
            self._drawn[number] = _DrawnTile(places, views, ViewIndex(descriptors))
        self._drawn.move_to_end(number)
        while len(self._drawn) > KEPT_TILES:
            self._drawn.popitem(last=False)
        return self._drawn[number]

    def region(self, numbers: tuple[int, ...], make: Callable[[tuple[int, ...]], Map]) -> Map:
        """Return some tiles together. Only the last result is kept: a map of few tiles always has the same, a larger one hardly ever.

        Args:
            numbers: numbers of the tiles, ascending.
            make: puts them together.
        """
        if self._last is None or self._last[0] != numbers:
            self._last = numbers, make(numbers)
        return self._last[1]

    def cloud(self, *_: object) -> None:
        """Return None: a drawn map has no cloud."""


def kept(numbers: DrawnViews, first: int, last: int) -> Int8[NDArray[np.int8], "n D"]:
    """Draw the views of a range into memory, some at a time.

    Args:
        numbers: descriptors of a map.
        first: number of the first view.
        last: number after that of the last view.
    """
    found = np.empty((last - first, numbers.shape[1]), np.int8)
    for start in range(first, last, _CHUNK):
        end = min(start + _CHUNK, last)
        found[start - first : end - first] = numbers[start:end]
    return found


def tiled_search(
    numbers: DrawnViews,
    search: PlaceSearch | None,
    asked: Asked,
    tenth: Float32[NDArray[np.float32], " Q"],
    tile_views: int,
) -> TiledSearch:
    """Measure the search of a tiled map without a prior.

    Args:
        numbers: descriptors of the map.
        search: chooses the tiles; None for a map of few tiles, which are all searched.
        asked: queries.
        tenth: similarity of each query's tenth best view by exact search in the whole map.
        tile_views: number of views of a tile.
    """
    opened = _map_of(numbers, search, DrawnTiles(numbers, tile_views))
    seconds = np.full((ROUNDS, len(tenth), 2), np.inf)
    found = np.zeros(len(tenth))
    for first in range(0, len(tenth), BATCH):
        batch = range(first, min(first + BATCH, len(tenth)))
        for query in batch:
            opened.searched(asked.descriptors[query].mean(axis=0))  # draws the tiles
        for times in seconds:
            for query in batch:
                turns = asked.descriptors[query]
                began = time.thread_time()
                part = opened.searched(turns.mean(axis=0))
                chosen = time.thread_time()
                # Only the heading of a match depends on the angles of the turns.
                matches = search_views(
                    part, turns, turns_rad=(0.0,) * len(turns), places=RANKED, fewest=ClusterSettings().views
                )
                times[query] = chosen - began, time.thread_time() - chosen
                found[query] = min(BEST, int((matches.similarity >= tenth[query] - 1e-6).sum()))
    choose, compare = 1e3 * np.median(seconds.min(axis=0), axis=0)
    whole = 1e3 * np.median(seconds.sum(axis=2).min(axis=0))
    return TiledSearch(float(whole), float(choose), float(compare), float(found.mean() / BEST))


def _map_of(numbers: DrawnViews, search: PlaceSearch | None, tiles: DrawnTiles) -> TiledMap:
    """Return the map of some tiles. It has nothing that a search does not read."""
    grid, sizes = ViewGrid(), np.diff(tiles.first_view).tolist()
    # only the two fields that a search reads
    counts: Any = {"views": len(numbers)}
    given: dict[str, Any] = {"headings": HEADINGS, "counts": Counts.model_construct(**counts)}
    read = Manifest.model_construct(**given)
    return TiledMap(
        path=Path(),
        manifest=read,
        grid=grid,
        rows_seen=np.ones(grid.rows, np.bool_),
        places=np.empty(0, PLACE),
        views=np.empty(0, VIEW),
        view_index=ViewIndex(numbers, JoinedShortlists(sizes, lambda number: tiles.get(number).view_index)),
        streets=None,
        streets_document=None,
        calibration=None,
        cloud=None,
        tiles=tiles,
        search=search,
    )
