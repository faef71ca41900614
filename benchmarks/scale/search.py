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
#: Best views that count for recall.
BEST = 10
#: Descriptors in memory that the exact comparison reads. The 12.5 GB of a hundred towns do not fit, so theirs are read at other places.
KEPT = 4_000_000
_CHUNK = 16_384
#: Rounds over all queries. A time is the median over the queries of each one's least processor time.
_ROUNDS = 3


@dataclass(frozen=True, slots=True)
class Found:
    """What a search in one map costs and finds.

    Attributes:
        ms: processor time of a search on one thread, ms: shortlist and exact comparison.
        recall: share of the ten best views by exact search that are found, mean over all queries.
    """

    ms: float
    recall: float


def search_rows(report: Report, real: RealDescriptors, work: Path, sizes: tuple[int, ...] = SIZES) -> None:
    """Add the rows of every size, and the bars of a hundred towns.

    Args:
        report: collects the rows and is written after each size.
        real: real descriptors.
        work: folder for index files, which are removed again.
        sizes: numbers of views, ascending.
    """
    if TOWNS not in sizes:
        for row_id, unit in BARRED.items():
            report.absent(row_id, unit, f"needs --sizes {TOWN} {TOWNS}")
    search_with_one_thread()
    scanned: dict[int, Found] = {}
    indexed: dict[int, Found] = {}
    for views in sizes:
        numbers = DrawnViews(real, views)
        asked = numbers.queries(QUERIES)
        tenth = tenth_best(numbers, asked)
        kept = numbers[: min(views, KEPT)]
        name = f"search.views_{views}"
        if views <= MOST_SCANNED:
            began = time.perf_counter()
            copy = ScannedCopy.of(kept)
            report.row(f"{name}.scan_open_s", time.perf_counter() - began, "s")
            scanned[views] = _rows(report, f"{name}.scan", copy, numbers, asked, tenth, kept)
        path = work / f"{views}.faiss"
        began = time.perf_counter()
        recall = write_inverted_file(path, numbers, headings=HEADINGS)
        report.row(f"{name}.index_build_s", time.perf_counter() - began, "s", n=views)
        report.row(
            f"{name}.index_recall_at_build", recall, "share", why="what `build-map` prints: views with noise as queries"
        )
        report.row(f"{name}.index_bytes_per_view", path.stat().st_size / views, "B", n=views)
        began = time.perf_counter()
        opened = InvertedFile.open(path, views=views, dimension=numbers.shape[1], headings=HEADINGS)
        report.row(f"{name}.index_open_s", time.perf_counter() - began, "s")
        report.row(f"{name}.index_probes", opened.probes, "lists", n=opened.lists)
        indexed[views] = _rows(report, f"{name}.index", opened, numbers, asked, tenth, kept)
        if views == TOWNS:
            _bars(report, scanned.get(TOWN), indexed.get(TOWN), indexed[views], path.stat().st_size / views)
        del opened
        path.unlink()
        print(f"written: {report.write()}", flush=True)


def _bars(report: Report, town: Found | None, town_indexed: Found | None, towns: Found, bytes_per_view: float) -> None:
    """Add the rows that have a bar: a hundred towns against the town."""
    report.row("search.recall_at_10_at_100_times_the_town", towns.recall, "share", bar=0.99, n=QUERIES)
    report.row("search.bytes_per_view", bytes_per_view, "B", bar=40, better="lower", n=TOWNS)
    if town is None or town_indexed is None:
        why = f"needs the town too: --sizes {TOWN} {TOWNS}"
        report.absent("search.ms_at_100_times_the_town", "ratio", why)
        return
    why = f"{towns.ms:.2f} ms against {town.ms:.2f} ms; the town is below the size of the index file, so it is scanned"
    report.row(
        "search.ms_at_100_times_the_town", towns.ms / town.ms, "ratio", bar=2, better="lower", n=QUERIES, why=why
    )
    why = f"{town_indexed.ms:.2f} ms for an index file of the town, which `build-map` does not write"
    report.row(
        "search.ms_at_100_times_the_indexed_town",
        towns.ms / town_indexed.ms,
        "ratio",
        better="lower",
        n=QUERIES,
        why=why,
    )


def _rows(
    report: Report,
    name: str,
    shortlister: Shortlister,
    numbers: DrawnViews,
    asked: Asked,
    tenth: NDArray[np.float32],
    kept: Int8[NDArray[np.int8], "n D"],
) -> Found:
    found = Found(
        search_ms(shortlister, asked, kept, min(SHORTLIST * WANTED, len(numbers))),
        recall_at_10(shortlister, asked, tenth, numbers.__getitem__, min(SHORTLIST * WANTED, len(numbers))),
    )
    report.row(f"{name}_ms", found.ms, "ms", n=len(asked.descriptors))
    report.row(f"{name}_recall_at_10", found.recall, "share", n=len(asked.descriptors))
    return found


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
