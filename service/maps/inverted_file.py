"""The index of a large map: an inverted file of short codes. It makes the shortlist without a scan of all views.

FAISS groups the views by their nearest centroid, and a search reads only the groups near the query. A graph (HNSW) over the centroids
finds these groups. The code of a view is its difference from the centroid, and takes four bits per axis. Views of neighbouring places look
alike, so the index of a dense survey holds about every second place, and a search adds the places in between. Decisions 0158 and 0184 have
the figures.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import faiss
import numpy as np
from jaxtyping import Float32, Int64
from numpy.typing import NDArray

from service.errors import damaged_file
from service.maps import index
from service.maps.index import Rows, Shortlister, vectors_of

FILE = "search.faiss"
#: Smallest number of views for this file. For fewer, a scan is exact and takes at most 1 ms longer (decision 0158).
SMALLEST = 1_000_000
#: Parameter of the manifest: recall@10 of the index against exact search, as measured when it was built.
RECALL = "search_recall_at_10"
#: Parameter of a tiled map: share of queries whose tile is among those that the index chooses, as measured when it was built.
FINDS_TILE = "search_finds_tile"
#: Number of principal axes. A map with fewer components has fewer.
_AXES = 128
#: The index omits a place with an odd number if its views are at least this similar to those of the place before or after it, as median
#: over the headings. Such places are up to 2.5 m apart (decision 0184).
_ALIKE = 0.85
#: Share of the views on either side that the range of a code leaves out. Rare values would make its steps too large.
_OUTLIERS = 0.005
#: Neighbours of a centroid in the graph.
_LINKS = 32
#: Fewest candidates of a search in the graph. More find nearer centroids and take longer.
_LEAST_CANDIDATES = 64
#: All listed views bring those of the places beside them. The first k / _BEST_PART of a list for k views bring the views of _PLACES places
#: to each side, also at the next headings.
_BEST_PART, _PLACES = 12, 3
#: Steps of k-means, and views for each centroid that it takes into account.
_STEPS, _VIEWS_PER_LIST = 6, 16
#: Smallest number of views that determine axes and ranges.
_SAMPLE = 65_536
#: Views that are read at once.
_CHUNK = 16_384
#: Queries that measure recall, views that each of them lists, and best views of these that count.
_QUERIES, _LISTED, _BEST = 128, 1_440, 10
#: Noise of these queries: the share of a difference between two views of the map that is added to a view.
_NOISE = 0.6
#: Recall to reach, and factor by which the number of lists that a search reads grows until then.
_WANTED, _GROWTH = 0.992, 2**0.5
#: The build stops if twice as many lists raise the recall by less than this.
_LEAST_GAIN = 0.002
_QueryDescriptors = Float32[NDArray[np.float32], "q D"]
#: FAISS without its type stubs, which lack many of the classes and fields that this file uses.
_faiss: Any = faiss


def write_inverted_file(path: Path, numbers: Rows, *, headings: int) -> float:
    """Build the index of a map and write it; return its recall@10 against exact search.

    The same descriptors give the same bytes on processors of one kind, for any number of threads.

    Args:
        path: the new file.
        numbers: 8-bit descriptors, a row per view, as ``write_descriptors`` stores them. Most places follow each other as in the survey.
        headings: number of views per place.
    """
    with _threads(1):
        held = views_to_hold(numbers, headings)
        whole = _trained(numbers, held)
        _add(whole, numbers, held)
        recall = _choose_probes(whole, numbers, headings)
        _faiss.write_index(whole, str(path))
    return recall


def lists_for(views: int) -> int:
    """Return the number of lists of an index: the power of two next to eight times the root of the number of views.

    Args:
        views: number of views, 1 or more.
    """
    return int(2 ** max(0, round(np.log2(8 * np.sqrt(views)))))


def views_to_hold(numbers: Rows, headings: int) -> Int64[NDArray[np.int64], " n"]:
    """Return the views that an index holds, ascending: those of all places with an even number, and of odd ones that look different.

    A place with an odd number is omitted if a place beside it looks alike, because a search adds the places beside those that it finds.
    Places that were appended to a map may look like neither.

    Args:
        numbers: 8-bit descriptors of all views.
        headings: number of views per place.
    """
    places = -(-len(numbers) // headings)
    # similarity of each place to the one before; that of the first place, and of a last place with fewer views, stays -1
    before = np.full(places + 1, -1.0)
    step = max(_CHUNK // headings, 1)
    for first in range(0, len(numbers) // headings - 1, step):
        last = min(first + step + 1, len(numbers) // headings)
        views = vectors_of(numbers[first * headings : last * headings]).reshape(last - first, headings, -1)
        before[first + 1 : last] = np.median(np.einsum("phd,phd->ph", views[1:], views[:-1]), axis=1)
    is_held = np.maximum(before[:-1], before[1:]) < _ALIKE
    is_held[::2] = True
    held = (np.flatnonzero(is_held)[:, None] * headings + np.arange(headings)).ravel()
    return held[held < len(numbers)]


class InvertedFile:
    """Open index of a large map. Several threads may search it at the same time.

    Args:
        whole: principal axes and inverted file.
        views: number of views of the map.
        headings: number of views per place.
    """

    def __init__(self, whole: Any, views: int, headings: int) -> None:
        self._views, self._headings = views, headings
        self._whole = whole  # keeps the parts below alive
        self._axes = _faiss.downcast_VectorTransform(whole.chain.at(0))
        self._lists = _faiss.downcast_index(whole.index)

    @classmethod
    def open(cls, path: Path, *, views: int, dimension: int, headings: int, verify: bool = True) -> "InvertedFile":
        """Map the index into memory.

        Args:
            path: file that ``write_inverted_file`` wrote.
            views: number of views of the map.
            dimension: number of components of a descriptor.
            headings: number of views per place.
            verify: check that the lists hold no view twice and all places with an even number, and that the graph refers to its own
                centroids.

        Raises:
            BundleError: the file is damaged, or belongs to another map.
        """
        index.search_with_one_thread()
        try:
            whole = _faiss.read_index(str(path), _faiss.IO_FLAG_MMAP | _faiss.IO_FLAG_READ_ONLY)
        except RuntimeError as error:
            reason = str(error).splitlines()[0].rpartition("Error: ")[2]
            raise damaged_file(path, f"not a valid FAISS index ({reason})") from error
        wrong = _unlike(whole, views, dimension, path.stat().st_size)
        if not wrong and verify:
            wrong = _inconsistent(_faiss.downcast_index(whole.index), views, headings)
        if wrong:
            raise damaged_file(path, wrong)
        # FAISS would start 32 threads for each search, which read the lists in advance (2 ms).
        _faiss.downcast_InvertedLists(_faiss.downcast_index(whole.index).invlists).prefetch_nthread = 0
        return cls(whole, views, headings)

    @property
    def lists(self) -> int:
        """Number of lists."""
        return int(self._lists.nlist)

    @property
    def probes(self) -> int:
        """Number of lists that a search reads at least."""
        return int(self._lists.nprobe)

    def shortlist(self, descriptor: Float32[NDArray[np.float32], " D"], k: int) -> Int64[NDArray[np.int64], " n"]:
        """Return the indices of about the k most similar views and of views next to them, ascending.

        Args:
            descriptor: descriptor of the query view.
            k: length of the list, at most the number of views.
        """
        found = self._by_codes(descriptor, -(-k * self._lists.ntotal // self._views))
        beside = self._around(found, places=1, turns=0)
        return np.union1d(beside, self._around(found[: -(-k // _BEST_PART)], places=_PLACES, turns=1))

    def most_similar(self, descriptor: Float32[NDArray[np.float32], " D"], k: int) -> Int64[NDArray[np.int64], " n"]:
        """Return the indices of about the k most similar views that the index holds, the most similar first.

        The codes of the views decide, without an exact comparison.

        Args:
            descriptor: descriptor of the query view.
            k: length of the list, at most the number of views. The index may hold fewer.
        """
        return self._by_codes(descriptor, min(k, self._lists.ntotal))

    def _by_codes(self, descriptor: Float32[NDArray[np.float32], " D"], k: int) -> Int64[NDArray[np.int64], " n"]:
        """Return the k most similar views by their codes, the best first.

        There are fewer only if the graph does not lead to all lists.
        """
        query, probes = self._axes.apply(descriptor[None]), self.probes
        while True:
            # The graph finds the nearest centroids only if it keeps as many candidates as it shall return.
            graph = _faiss.SearchParametersHNSW(efSearch=max(probes, _LEAST_CANDIDATES))
            reading = _faiss.SearchParametersIVF(nprobe=probes, quantizer_params=graph)
            found: NDArray[np.int64] = self._lists.search(query, k, params=reading)[1][0]
            found = found[found >= 0]
            if len(found) == k or probes >= self.lists:
                return found
            probes *= 2  # these lists have fewer than k views

    def _around(
        self, views: Int64[NDArray[np.int64], " n"], *, places: int, turns: int
    ) -> Int64[NDArray[np.int64], " m"]:
        """Return some views and those around them: of places next to theirs by number, at headings next to theirs."""
        place, heading = np.divmod(views, self._headings)
        turned = (heading[:, None] + np.arange(-turns, turns + 1)) % self._headings
        along = place[:, None] + np.arange(-places, places + 1)
        around = (along[:, :, None] * self._headings + turned[:, None, :]).ravel()
        inside: NDArray[np.int64] = around[(around >= 0) & (around < self._views)]
        return inside


@contextmanager
def _threads(count: int) -> Iterator[None]:
    """Make FAISS use some threads. With more than one, the graph and the rounding of sums depend on them, but no search does."""
    before = _faiss.omp_get_max_threads()
    _faiss.omp_set_num_threads(count)
    try:
        yield
    finally:
        _faiss.omp_set_num_threads(before)


def _trained(numbers: Rows, held: Int64[NDArray[np.int64], " n"]) -> Any:
    """Return an index with axes, centroids and codes, but without views."""
    # Each list needs a view as its centroid.
    size, lists = numbers.shape[1], min(lists_for(len(numbers)), 2 ** int(np.log2(len(held))))
    name = f"PCA{min(_AXES, size, len(held))},IVF{lists}_HNSW{_LINKS},SQ4"
    whole = _faiss.index_factory(size, name, _faiss.METRIC_INNER_PRODUCT)
    axes, inverted = _faiss.downcast_VectorTransform(whole.chain.at(0)), _faiss.downcast_index(whole.index)
    settings = inverted.cp
    settings.niter, settings.max_points_per_centroid, settings.min_points_per_centroid = _STEPS, _VIEWS_PER_LIST, 1
    inverted.sq.rangestat, inverted.sq.rangestat_arg = _faiss.ScalarQuantizer.RS_quantiles, _OUTLIERS
    # The graph finds the nearest centroid of a view without a comparison with all centroids.
    graph = _faiss.IndexHNSWFlat(inverted.d, _LINKS, _faiss.METRIC_INNER_PRODUCT)
    inverted.clustering_index = graph
    count = min(len(held), max(_SAMPLE, _VIEWS_PER_LIST * lists))
    # Drawn at random, because views at equal distances may all have one heading.
    rows = np.random.default_rng(0).choice(len(held), count, replace=False)
    sample = vectors_of(numbers[held[np.sort(rows)]])
    # With their opposites the views have a mean of zero. So the axes keep the length of a view, and spherical centroids fit.
    some = sample[:: -(-len(sample) // _SAMPLE)]
    axes.train(np.concatenate([some, -some]))
    inverted.train(axes.apply(sample))
    inverted.clustering_index = None  # the graph ends with this function
    whole.is_trained = True
    return whole


def _add(whole: Any, numbers: Rows, held: Int64[NDArray[np.int64], " n"]) -> None:
    """Add some views in their order, with their numbers. Lists and codes of a view do not depend on the number of threads."""
    axes, inverted = _faiss.downcast_VectorTransform(whole.chain.at(0)), _faiss.downcast_index(whole.index)
    for first in range(0, len(held), _CHUNK):
        some = held[first : first + _CHUNK]
        along = axes.apply(vectors_of(numbers[some]))
        with _threads(os.cpu_count() or 1):
            inverted.add_with_ids(along, some)
    whole.ntotal = inverted.ntotal


def _choose_probes(whole: Any, numbers: Rows, headings: int) -> float:
    """Set about the smallest number of probes that reaches the recall wanted, or that more probes hardly improve; return the recall.

    Args:
        whole: index.
        numbers: descriptors of all views.
        headings: number of views per place.
    """
    queries, _ = noisy_queries(numbers)
    tenth = _tenth_best(numbers, queries)
    inverted, opened = _faiss.downcast_index(whole.index), InvertedFile(whole, len(numbers), headings)
    # The lists that hold about the shortlist. With fewer, a search reads more of them anyway.
    fewest = min(_LISTED, len(numbers)) * inverted.nlist / len(numbers)
    tried: list[tuple[int, float]] = []
    while True:
        inverted.nprobe = min(round(max(fewest, 1.0) * _GROWTH ** len(tried)), inverted.nlist)
        recall = recall_of(opened, numbers, queries, tenth)
        tried.append((inverted.nprobe, recall))
        if recall >= _WANTED or inverted.nprobe == inverted.nlist:
            return recall
        half_probes, half_recall = tried[max(len(tried) - 3, 0)]
        if len(tried) > 2 and recall - half_recall < _LEAST_GAIN:
            inverted.nprobe = half_probes
            return half_recall


def recall_of(opened: Shortlister, numbers: Rows, queries: _QueryDescriptors, tenth: NDArray[np.float32]) -> float:
    """Return the share of the ten most similar views that the shortlist has, mean over all queries.

    Views as similar as the tenth count as much as the tenth.

    Args:
        opened: the index.
        numbers: descriptors of all views (n, D).
        queries: descriptors of the queries (q, D).
        tenth: similarity of each query's tenth best view (q,).
    """
    best, listed = min(_BEST, len(numbers)), min(_LISTED, len(numbers))
    found = 0
    for query, least in zip(queries, tenth, strict=True):
        similarity = vectors_of(numbers[opened.shortlist(query, listed)]) @ query
        found += min(best, int((similarity >= least - 1e-6).sum()))
    return found / (best * len(queries))


def noisy_queries(numbers: Rows) -> tuple[_QueryDescriptors, Int64[NDArray[np.int64], " q"]]:
    """Return views with the noise of two views of one place, as queries, and the number of each one's own view.

    The spectrum of the noise is that of the map's own descriptors.

    Args:
        numbers: 8-bit descriptors of all views.
    """
    rng = np.random.default_rng(0)
    count = min(_QUERIES, len(numbers))
    own, *drawn = (np.sort(rng.integers(len(numbers), size=count)) for _ in range(3))
    view, one, other = (vectors_of(numbers[each]) for each in (own, *drawn))
    noisy = view + _NOISE * (one - rng.permutation(other))
    queries: _QueryDescriptors = noisy / np.maximum(np.linalg.norm(noisy, axis=1, keepdims=True), 1e-12)
    return queries, own


def _tenth_best(numbers: Rows, queries: _QueryDescriptors) -> Float32[NDArray[np.float32], " q"]:
    """Return the similarity of the tenth best view of each query by exact search, or of the last one of fewer views."""
    kept = np.full((len(queries), min(_BEST, len(numbers))), -np.inf, np.float32)
    for first in range(0, len(numbers), _CHUNK):
        similar = queries @ vectors_of(numbers[first : first + _CHUNK]).T
        least = kept.min(axis=1, keepdims=True)
        for query in np.flatnonzero((similar > least).any(axis=1)):
            both = np.concatenate([kept[query], similar[query][similar[query] > least[query]]])
            kept[query] = -np.partition(-both, kept.shape[1] - 1)[: kept.shape[1]]
    tenth: NDArray[np.float32] = kept.min(axis=1)
    return tenth


def _unlike(whole: Any, views: int, dimension: int, size: int) -> str:
    """Return how an index differs from that of a map; empty if it fits."""
    if not isinstance(whole, _faiss.IndexPreTransform) or whole.chain.size() != 1:
        return f"{type(whole).__name__} instead of principal axes with an inverted file"
    axes, inverted = _faiss.downcast_VectorTransform(whole.chain.at(0)), _faiss.downcast_index(whole.index)
    if not isinstance(axes, _faiss.PCAMatrix) or not isinstance(inverted, _faiss.IndexIVFScalarQuantizer):
        return f"{type(axes).__name__} and {type(inverted).__name__} instead of PCAMatrix and IndexIVFScalarQuantizer"
    graph, lists = _faiss.downcast_index(inverted.quantizer), _faiss.downcast_InvertedLists(inverted.invlists)
    if not isinstance(graph, _faiss.IndexHNSWFlat) or not isinstance(lists, _faiss.OnDiskInvertedLists):
        return f"{type(graph).__name__} and {type(lists).__name__} instead of IndexHNSWFlat and OnDiskInvertedLists"
    if inverted.ntotal != lists.compute_ntotal() or not views <= 2 * inverted.ntotal <= 2 * views:
        return f"{inverted.ntotal} views in its head and {lists.compute_ntotal()} in its lists for a map of {views}"
    if whole.d != dimension or axes.d_out != inverted.d or graph.d != inverted.d:
        return f"descriptors of {whole.d} numbers instead of {dimension}, or parts that do not fit together"
    if graph.ntotal != inverted.nlist or not 1 <= inverted.nprobe <= inverted.nlist:
        return f"{graph.ntotal} centroids and {inverted.nprobe} probes for {inverted.nlist} lists"
    last = lists.lists.at(inverted.nlist - 1)
    if (
        inverted.sq.qtype != _faiss.ScalarQuantizer.QT_4bit
        or inverted.code_size != (inverted.d + 1) // 2
        or last.offset + last.size * (inverted.code_size + 8) > size
    ):
        return "the codes do not fit into the file"
    return ""


def _inconsistent(inverted: Any, views: int, headings: int) -> str:
    """Return which reference of an index leads nowhere or which view is missing; empty if there is none."""
    lists, seen = _faiss.downcast_InvertedLists(inverted.invlists), np.zeros(views, np.bool_)
    for number in range(inverted.nlist):
        count = lists.list_size(number)
        if not count:
            continue
        held: NDArray[np.int64] = _faiss.rev_swig_ptr(lists.get_ids(number), count)
        if held.min() < 0 or held.max() >= views:
            return f"list {number} refers to a missing view"
        seen[held] = True
    if (found := int(seen.sum())) != inverted.ntotal:
        return f"{inverted.ntotal - found} views are in two lists"
    places = -(-views // headings)
    seen.resize(places * headings, refcheck=False)  # a last place may have fewer views
    seen[views:] = True
    if missing := int((~seen.reshape(places, headings)[::2]).sum()):
        return f"{missing} views of every second place are in no list"
    graph = _faiss.downcast_index(inverted.quantizer).hnsw
    neighbours = _faiss.vector_to_array(graph.neighbors)
    if len(neighbours) and not -1 <= neighbours.min() <= neighbours.max() < inverted.nlist:
        return "the graph refers to a missing centroid"
    return ""
