"""Shared parts of the retrieval methods: places about a metre apart, and the answer of the nearest places."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from research.baselines.answers import PlaceAnswers

#: Number of nearest places that vote for the street.
NEIGHBOURS = 5


def thinned(xy: NDArray[np.float64], spacing_m: float) -> NDArray[np.int64]:
    """Return rows of positions, in order, of which none is nearer than ``spacing_m`` to an earlier one.

    The result has shape (m,).

    Args:
        xy: positions (n, 2), metres.
        spacing_m: smallest distance, metres.
    """
    near = cKDTree(xy).query_ball_point(xy, spacing_m * (1 - 1e-9))
    kept = np.zeros(len(xy), np.bool_)
    for row, others in enumerate(near):
        kept[row] = not kept[others].any()
    return np.flatnonzero(kept)


def answers_of(
    similarity: NDArray[np.float32], xy: NDArray[np.float64], street: NDArray[np.int64], *, views: int = 1
) -> PlaceAnswers:
    """Answer the position of the most similar place, and the majority street of the ``NEIGHBOURS`` most similar places.

    Args:
        similarity: similarities (queries, places * views), larger is nearer; a query without a finite value gets no
            answer.
        xy: positions of the places (places, 2), metres, map frame.
        street: street classes of the places (places,); with equal votes, the class of the nearest neighbour wins.
        views: views per place, adjacent; a place is as similar as its best view.
    """
    of_place = similarity.reshape(len(similarity), len(xy), views).max(axis=2)
    order = np.argsort(-of_place, axis=1, kind="stable")[:, :NEIGHBOURS]
    known = np.isfinite(np.take_along_axis(of_place, order[:, :1], axis=1)[:, 0])
    votes = street[order]
    # A nearer place has a slightly larger vote, so that a tie goes to the class of the nearest one.
    worth = 1.0 + np.ldexp(1.0, -np.arange(1, votes.shape[1] + 1)) / NEIGHBOURS
    count = np.zeros((len(votes), int(street.max()) + 1))
    for rank in range(votes.shape[1]):
        count[np.arange(len(votes)), votes[:, rank]] += worth[rank]
    return PlaceAnswers(
        np.where(known[:, None], xy[order[:, 0]], np.nan), np.where(known, count.argmax(axis=1), -1).astype(np.int64)
    )
