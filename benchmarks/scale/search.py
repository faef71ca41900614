"""Search in drawn maps of several sizes: time, recall, bytes and build time of the scan and of the inverted file."""

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
from service.maps.index import ScannedCopy, Shortlister, search_with_one_thread, vectors_of
from service.maps.inverted_file import InvertedFile, write_inverted_file
from service.maps.tiles import LISTED, MOST_SEARCHED, PlaceSearch, in_order
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
#: Queries, and views that an answer takes from a search by default.
QUERIES, WANTED = 100, 240
#: Views of a tile of 500 places.
TILE_VIEWS = 500 * HEADINGS
#: Best views that count for recall.
BEST = 10
#: Descriptors in memory that the exact comparison reads. The 12.5 GB of a hundred towns do not fit, so theirs are read at other places.
KEPT = 4_000_000
_CHUNK = 16_384
#: Rounds over all queries. A time is the median over the queries of each one's least processor time.
_ROUNDS = 3


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
        for row_id, unit in BARRED.items():
            report.absent(row_id, unit, f"needs --sizes {TOWN} {TOWNS}")
    search_with_one_thread()
    ready: list[Ready] = []
    paths = [work / f"{views}.faiss" for views in sizes]
    try:
        for views, path in zip(sizes, paths, strict=True):
            ready += _built(report, DrawnViews(real, views), path)
            print(f"written: {report.write()}", flush=True)
        times = _time_rows(report, ready, _kept(DrawnViews(real, min(max(sizes), KEPT))))
    finally:
        for path in paths:
            path.unlink(missing_ok=True)
    if TOWNS in sizes:
        _ratio_rows(report, times)
    print(f"written: {report.write()}", flush=True)


def _built(report: Report, numbers: DrawnViews, path: Path) -> list[Ready]:
    """Build the searches of one size, add all rows but their times, and return them."""
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
    report.share(f"{row}.index_finds_tile", finds_tile(opened, asked, views))
    if views == TOWNS:
        report.row("search.recall_at_10_at_100_times_the_town", recall, "share", bar=0.99, n=QUERIES)
        report.row("search.bytes_per_view", bytes_per_view, "B", bar=40, better="lower", n=TOWNS)
    return [*ready, Ready(f"{row}.index", opened, asked, views)]


def finds_tile(opened: PlaceSearch, asked: Asked, views: int) -> NDArray[np.bool_]:
    """Return for each query whether its tile is among those that a tiled map searches without a prior. The codes alone decide.

    Args:
        opened: the index.
        asked: queries.
        views: number of views of the map.
    """
    found = np.zeros(len(asked.descriptors), np.bool_)
    for number, (turns, true) in enumerate(zip(asked.descriptors, asked.true_view, strict=True)):
        similar = opened.most_similar(turns.mean(axis=0), min(LISTED, views))
        found[number] = true // TILE_VIEWS in in_order(similar // TILE_VIEWS)[:MOST_SEARCHED]
    return found


def _kept(numbers: DrawnViews) -> Int8[NDArray[np.int8], "n D"]:
    """Draw all views, some at a time, because drawing needs sixteen times the memory."""
    kept = np.empty(numbers.shape, np.int8)
    for first in range(0, len(numbers), _CHUNK):
        kept[first : first + _CHUNK] = numbers[first : first + _CHUNK]
    return kept


def _time_rows(report: Report, ready: list[Ready], kept: Int8[NDArray[np.int8], "n D"]) -> dict[str, float]:
    """Measure each search; add and return the times, ms. ``kept`` has the first views of the largest map, which all maps share."""
    times = {}
    for each in ready:
        listed = min(SHORTLIST * WANTED, each.views)
        times[each.row] = search_ms(each.shortlister, each.asked, kept[: each.views], listed)
        report.row(f"{each.row}_ms", times[each.row], "ms", n=QUERIES)
        report.write()
    return times


def _ratio_rows(report: Report, times: dict[str, float]) -> None:
    """Add the times of a hundred towns over those of the town."""
    towns, town = times[f"search.views_{TOWNS}.index"], times.get(f"search.views_{TOWN}.scan")
    indexed = times.get(f"search.views_{TOWN}.index")
    if town is None or indexed is None:
        report.absent("search.ms_at_100_times_the_town", "ratio", f"needs the town too: --sizes {TOWN} {TOWNS}")
        return
    for row_id, one, bar, why in (
        ("search.ms_at_100_times_the_town", town, 2, "the town is below the size of the index file, so it is scanned"),
        (
            "search.ms_at_100_times_the_indexed_town",
            indexed,
            None,
            "with an index file, which `build-map` does not write",
        ),
    ):
        told = f"{towns:.2f} ms against {one:.2f} ms; {why}"
        report.row(row_id, towns / one, "ratio", bar=bar, better="lower", n=QUERIES, why=told)


def search_ms(shortlister: Shortlister, asked: Asked, kept: Int8[NDArray[np.int8], "n D"], listed: int) -> float:
    """Return the processor time of a search, ms: median over the queries.

    The steps are those of ``knn.search_views``: a shortlist by the mean of the turns, and an exact comparison with each turn.

    Args:
        shortlister: makes the shortlist.
        asked: queries.
        kept: descriptors to compare with. A view beyond them is read at another place, which takes as long.
        listed: length of the shortlist.
    """
    took = np.full((_ROUNDS, len(asked.descriptors)), np.inf)
    for times in took:
        for number, turns in enumerate(asked.descriptors):
            began = time.thread_time()
            views = shortlister.shortlist(turns.mean(axis=0), listed)
            best = (vectors_of(kept[views % len(kept)]) @ turns.T).max(axis=1)
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
