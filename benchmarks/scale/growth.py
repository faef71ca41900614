"""How recall falls with the length of the surveyed streets, by retrieval alone, in drawn maps."""

import numpy as np
from jaxtyping import Int64
from numpy.typing import NDArray

from benchmarks.report import Report
from benchmarks.scale.drawn import Asked, DrawnViews
from benchmarks.scale.sources import HEADINGS, RealDescriptors
from service.maps.index import Rows, vectors_of

#: Lengths of streets, km, with a place for each metre; and number of queries.
LENGTHS_KM, QUERIES = (1, 10, 100), 1_000
#: A place is right up to this many places from the true one, so up to as many metres along the survey.
RIGHT_PLACES = 5
#: Reach of a prior in both directions, places.
PRIOR_PLACES = 50
#: Numbers of first places that contain the right one. The last is what a second comparison could re-rank.
FIRST = (1, 10, 100)
_PLACES_AT_ONCE = 512


def growth_rows(report: Report, real: RealDescriptors, lengths_km: tuple[int, ...] = LENGTHS_KM) -> None:
    """Add the recall for each length, with and without a prior.

    Half of the queries have precise depth, half have stereo depth.

    Args:
        report: collects the rows.
        real: real descriptors.
        lengths_km: lengths of streets, km.
    """
    for length_km in lengths_km:
        numbers = DrawnViews(real, 1_000 * length_km * HEADINGS)
        asked = numbers.queries(QUERIES)
        ranks, near_ranks = ranks_of_truth(numbers, asked)
        name = f"growth.km_{length_km}"
        for first in FIRST:
            report.share(f"{name}.recall_at_{first}_5m", ranks < first)
        report.share(f"{name}.prior_{PRIOR_PLACES}_m.recall_at_1_5m", near_ranks < 1)
        print(f"{name}: recall@1 {(ranks < 1).mean():.3f}", flush=True)


def ranks_of_truth(numbers: Rows, asked: Asked) -> tuple[Int64[NDArray[np.int64], " Q"], ...]:
    """Return how many places are more similar to each query than the right ones: among all places, and within ``PRIOR_PLACES``.

    The similarity of a place is that of its best view and turn, by exact search.

    Args:
        numbers: the map.
        asked: queries.
    """
    places = len(numbers) // HEADINGS
    true_place = asked.true_view // HEADINGS
    right = np.full(len(true_place), -np.inf, np.float32)
    for query, (turns, place) in enumerate(zip(asked.descriptors, true_place, strict=True)):
        near = np.arange(max(place - RIGHT_PLACES, 0), min(place + RIGHT_PLACES + 1, places))
        right[query] = (_vectors(numbers, near) @ turns.T).max()
    by_turn = [np.ascontiguousarray(turn) for turn in asked.descriptors.transpose(1, 2, 0)]
    more, more_near = np.zeros(len(true_place), np.int64), np.zeros(len(true_place), np.int64)
    for first in range(0, places, _PLACES_AT_ONCE):
        some = np.arange(first, min(first + _PLACES_AT_ONCE, places))
        vectors = _vectors(numbers, some)
        similar = np.maximum.reduce([vectors @ turn for turn in by_turn])
        better = similar.reshape(len(some), HEADINGS, -1).max(axis=1) > right + 1e-6
        more += better.sum(axis=0)
        more_near += (better & (np.abs(some[:, None] - true_place) <= PRIOR_PLACES)).sum(axis=0)
    return more, more_near


def _vectors(numbers: Rows, places: Int64[NDArray[np.int64], " n"]) -> NDArray[np.float32]:
    """Return the unit vectors of all views of some places."""
    return vectors_of(numbers[(places[:, None] * HEADINGS + np.arange(HEADINGS)).ravel()])
