"""Search in drawn maps of several sizes: time, recall, bytes and build time of the scan and of the inverted file.

``scan`` and ``index`` are the two searches of a map of one bundle. ``tiled`` is the search of a tiled map without a prior.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int8, Int64
from numpy.typing import NDArray

from benchmarks.report import Report
from benchmarks.scale.drawn import Asked, DrawnViews
from benchmarks.scale.sources import HEADINGS, RealDescriptors
from benchmarks.scale.tiled import BEST, ROUNDS, TiledSearch, kept, tiled_search
from benchmarks.scale.town import TILE_M, TOWN_M
from service.maps.index import ScannedCopy, Shortlister, search_with_one_thread, vectors_of
from service.maps.inverted_file import InvertedFile, write_inverted_file
from service.maps.tiles import MOST_SEARCHED, finds_tile
from service.retrieval.knn import SHORTLIST

#: Views of the town of 1 x 1 km and 20 km of streets, and of a hundred such towns.
TOWN, TOWNS = 489_000, 100 * 489_000
#: Sizes of the drawn maps, and the largest that is also scanned. A larger scan is as much slower as the map is larger.
SIZES, MOST_SCANNED = (100_000, TOWN, 1_000_000, 10_000_000, TOWNS), 1_000_000
#: Rows of a hundred towns that have a bar, and their units.
BARRED = {
    "search.ms_at_100_times_the_town": "ratio",
    "search.recall_at_10_at_100_times_the_town": "share",
    "search.bytes_per_view": "B",
}
#: Ratio of the times of tiled maps. The bar of the issue is that of ``search.ms_at_100_times_the_town``.
SERVED = "search.served_ms_at_100_times_the_town"
#: Queries, and views that an answer takes from a search by default.
QUERIES, WANTED = 100, 240
#: Tiles of the town, and views of each of them.
TOWN_TILES = round(TOWN_M[0] * TOWN_M[1] / TILE_M**2)
TILE_VIEWS = HEADINGS * math.ceil(TOWN / HEADINGS / TOWN_TILES)
#: Descriptors in memory that the exact comparison reads. The 12.5 GB of a hundred towns do not fit, so theirs are read at other places.
KEPT = 4_000_000
_CHUNK = 16_384


@dataclass(frozen=True, slots=True, eq=False)
class Ready:
    """A search in one map that is ready to be timed.

    Attributes:
        row: name that its rows begin with.
        shortlister: makes the shortlist.
        asked: queries.
        views: number of views of the map.
    """

    row: str
    shortlister: Shortlister
    asked: Asked
    views: int


@dataclass(frozen=True, slots=True, eq=False)
class ReadyTiles:
    """A tiled map that is ready to be searched.

    Attributes:
        row: name that its rows begin with.
        numbers: descriptors of the map.
        search: chooses the tiles; None if all are searched.
        asked: queries.
        tenth: similarity of each query's tenth best view by exact search.
    """

    row: str
    numbers: DrawnViews
    search: InvertedFile | None
    asked: Asked
    tenth: Float32[NDArray[np.float32], " Q"]


def search_rows(report: Report, real: RealDescriptors, work: Path, sizes: tuple[int, ...] = SIZES) -> None:
    """Add the rows of every size, and the bars of a hundred towns.

    All indices are built first. The times are measured one after the other at the end, so that they can be compared.

    Args:
        report: collects the rows. It is written after each size and after each time.
        real: real descriptors.
        work: folder for index files, which are removed again.
        sizes: numbers of views, ascending.
    """
    if TOWNS not in sizes:
        for row_id, unit in {**BARRED, SERVED: "ratio"}.items():
            report.absent(row_id, unit, f"needs --sizes {TOWN} {TOWNS}")
    search_with_one_thread()
    ready: list[Ready] = []
    tiled: list[ReadyTiles] = []
    paths = [work / f"{views}.faiss" for views in sizes]
    try:
        for views, path in zip(sizes, paths, strict=True):
            searches, tiles = _built(report, DrawnViews(real, views), path)
            ready, tiled = [*ready, *searches], [*tiled, *tiles]
            print(f"written: {report.write()}", flush=True)
        most = min(max(sizes), KEPT)
        times = _time_rows(report, ready, kept(DrawnViews(real, most), 0, most))
        times |= _tiled_rows(report, tiled)
    finally:
        for path in paths:
            path.unlink(missing_ok=True)
    if TOWNS in sizes:
        _ratio_rows(report, times)
    print(f"written: {report.write()}", flush=True)


def _built(report: Report, numbers: DrawnViews, path: Path) -> tuple[list[Ready], list[ReadyTiles]]:
    """Build the searches of one size, add all rows but their times, and return them. A map of one tile has no search of a tiled map."""
    views, row, ready = len(numbers), f"search.views_{len(numbers)}", []
    asked = numbers.queries(QUERIES)
    tenth, listed = tenth_best(numbers, asked), min(SHORTLIST * WANTED, views)
    if views <= MOST_SCANNED:
        began = time.perf_counter()
        copy = ScannedCopy.of(numbers[:])
        report.row(f"{row}.scan_open_s", time.perf_counter() - began, "s")
        recall = recall_at_10(copy, asked, tenth, numbers.__getitem__, listed)
        report.row(f"{row}.scan_recall_at_10", recall, "share", n=QUERIES)
        ready.append(Ready(f"{row}.scan", copy, asked, views))
    began = time.perf_counter()
    recall = write_inverted_file(path, numbers, headings=HEADINGS)
    report.row(f"{row}.index_build_s", time.perf_counter() - began, "s", n=views)
    why = "what `build-map` prints: views with noise as queries"
    report.row(f"{row}.index_recall_at_build", recall, "share", why=why)
    bytes_per_view = path.stat().st_size / views
    report.row(f"{row}.index_bytes_per_view", bytes_per_view, "B", n=views)
    began = time.perf_counter()
    opened = InvertedFile.open(path, views=views, dimension=numbers.shape[1], headings=HEADINGS)
    report.row(f"{row}.index_open_s", time.perf_counter() - began, "s")
    report.row(f"{row}.index_probes", opened.probes, "lists", n=opened.lists)
    recall = recall_at_10(opened, asked, tenth, numbers.__getitem__, listed)
    report.row(f"{row}.index_recall_at_10", recall, "share", n=QUERIES)
    first_view = np.append(np.arange(0, views, TILE_VIEWS), views)
    tiles = len(first_view) - 1
    finds = finds_tile(opened, asked.descriptors.mean(axis=1), asked.true_view, first_view)
    report.share(f"{row}.index_finds_tile", finds, why=f"{_searched_of(tiles)}; {_tile_text()}")
    if views == TOWNS:
        report.row("search.recall_at_10_at_100_times_the_town", recall, "share", bar=0.99, n=QUERIES)
        report.row("search.bytes_per_view", bytes_per_view, "B", bar=40, better="lower", n=TOWNS)
    searches = [*ready, Ready(f"{row}.index", opened, asked, views)]
    # A tiled map of few tiles searches all of them.
    chooses = opened if tiles > MOST_SEARCHED else None
    return searches, [ReadyTiles(f"{row}.tiled", numbers, chooses, asked, tenth)] if tiles > 1 else []


def _searched_of(tiles: int) -> str:
    """Return how many tiles of a map are searched without a prior."""
    return f"all {tiles} tiles are searched" if tiles <= MOST_SEARCHED else f"{MOST_SEARCHED} of {tiles} tiles"


def _tile_text() -> str:
    """Return the size of a tile, and where it comes from."""
    return f"a tile of {TILE_M:g} m has {TILE_VIEWS:,} views: the town has {TOWN:,} in {TOWN_TILES} tiles, {HEADINGS} for each place"


def _tiled_rows(report: Report, ready: list[ReadyTiles]) -> dict[str, float]:
    """Measure the search of each tiled map; add its rows and return the times, ms."""
    times = {}
    for each in ready:
        found: TiledSearch = tiled_search(each.numbers, each.search, each.asked, each.tenth, TILE_VIEWS)
        times[each.row] = found.ms
        tiles = _searched_of(math.ceil(len(each.numbers) / TILE_VIEWS))
        report.row(
            f"{each.row}_ms",
            found.ms,
            "ms",
            n=QUERIES,
            why=f"{tiles}: {found.choose_ms:.1f} ms to choose them and put them together, {found.compare_ms:.1f} ms to scan and compare; "
            f"default options of a query; {_tile_text()}",
        )
        why = f"of the ten best views of the whole map; {tiles}"
        report.row(f"{each.row}_recall_at_10", found.recall, "share", n=QUERIES, why=why)
        report.write()
    return times


def _time_rows(report: Report, ready: list[Ready], drawn: Int8[NDArray[np.int8], "n D"]) -> dict[str, float]:
    """Measure each search; add and return the times, ms. ``drawn`` has the first views of the largest map, which all maps share."""
    times = {}
    for each in ready:
        listed = min(SHORTLIST * WANTED, each.views)
        times[each.row] = search_ms(each.shortlister, each.asked, drawn[: each.views], listed)
        report.row(f"{each.row}_ms", times[each.row], "ms", n=QUERIES)
        report.write()
    return times


def _ratio_rows(report: Report, times: dict[str, float]) -> None:
    """Add the times of a hundred towns over those of the town."""
    of_all, of_one = (_searched_of(math.ceil(views / TILE_VIEWS)) for views in (TOWNS, TOWN))
    ratios = (
        (
            "search.ms_at_100_times_the_town",
            "index",
            "scan",
            2,
            f"both as maps of one bundle: the town is below the size of the index file, so it is scanned. {SERVED} has tiled maps",
        ),
        (
            "search.ms_at_100_times_the_indexed_town",
            "index",
            "index",
            None,
            "with an index file, which `build-map` does not write",
        ),
        (
            SERVED,
            "tiled",
            "tiled",
            None,
            f"both as tiled maps serve them without a prior: {of_all}, and in the town {of_one}",
        ),
    )
    for row_id, of_towns, of_town, bar, why in ratios:
        towns, town = times.get(f"search.views_{TOWNS}.{of_towns}"), times.get(f"search.views_{TOWN}.{of_town}")
        if towns is None or town is None:
            report.absent(row_id, "ratio", f"needs the town too: --sizes {TOWN} {TOWNS}")
            continue
        told = f"{towns:.2f} ms against {town:.2f} ms; {why}"
        report.row(row_id, towns / town, "ratio", bar=bar, better="lower", n=QUERIES, why=told)


def search_ms(shortlister: Shortlister, asked: Asked, drawn: Int8[NDArray[np.int8], "n D"], listed: int) -> float:
    """Return the processor time of a search, ms: median over the queries.

    The steps are those of ``knn.search_views``: a shortlist by the mean of the turns, and an exact comparison with each turn.

    Args:
        shortlister: makes the shortlist.
        asked: queries.
        drawn: descriptors to compare with. A view beyond them is read at another place, which takes as long.
        listed: length of the shortlist.
    """
    took = np.full((ROUNDS, len(asked.descriptors)), np.inf)
    for times in took:
        for number, turns in enumerate(asked.descriptors):
            began = time.thread_time()
            views = shortlister.shortlist(turns.mean(axis=0), listed)
            best = (vectors_of(drawn[views % len(drawn)]) @ turns.T).max(axis=1)
            np.argsort(-best, kind="stable")[:WANTED]
            times[number] = time.thread_time() - began
    return float(1e3 * np.median(took.min(axis=0)))


def recall_at_10(
    shortlister: Shortlister,
    asked: Asked,
    tenth: NDArray[np.float32],
    read: Callable[[Int64[NDArray[np.int64], " n"]], Int8[NDArray[np.int8], "n D"]],
    listed: int,
) -> float:
    """Return the share of the ten best views that a search finds, mean over the queries.

    The exact comparison ranks the shortlist. So a best view is found if the shortlist has it.

    Args:
        shortlister: makes the shortlist.
        asked: queries.
        tenth: similarity of the tenth best view by exact search.
        read: returns the 8-bit descriptors of some views.
        listed: length of the shortlist.
    """
    found = 0
    for turns, least in zip(asked.descriptors, tenth, strict=True):
        best = (vectors_of(read(shortlister.shortlist(turns.mean(axis=0), listed))) @ turns.T).max(axis=1)
        found += min(BEST, int((best >= least - 1e-6).sum()))
    return found / (BEST * len(asked.descriptors))


def tenth_best(numbers: DrawnViews, asked: Asked) -> Float32[NDArray[np.float32], " Q"]:
    """Return the similarity of each query's tenth best view by exact search over all views and turns.

    Args:
        numbers: the map, of ten views or more.
        asked: queries.
    """
    by_turn = [np.ascontiguousarray(turn) for turn in asked.descriptors.transpose(1, 2, 0)]
    kept = np.full((len(asked.descriptors), BEST), -np.inf, np.float32)
    for first in range(0, len(numbers), _CHUNK):
        vectors = vectors_of(numbers[first : first + _CHUNK])
        similar = np.maximum.reduce([vectors @ turn for turn in by_turn])
        rows, queries = np.nonzero(similar > kept.min(axis=1))
        for query in np.unique(queries):
            both = np.concatenate([kept[query], similar[rows[queries == query], query]])
            kept[query] = -np.partition(-both, BEST - 1)[:BEST]
    tenth: NDArray[np.float32] = kept.min(axis=1)
    return tenth
