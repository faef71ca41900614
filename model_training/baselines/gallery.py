"""What the methods that look a query up share: places about a metre apart, and the answer that the nearest of them give."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from model_training.baselines.answers import PlaceAnswers

NEIGHBOURS = 5  # that vote for the street


def thinned(xy: NDArray[np.float64], spacing_m: float) -> NDArray[np.int64]:
    """Rows of ``xy`` (n, 2), in their order, of which none lies nearer than ``spacing_m`` to one that was kept before it."""
    near = cKDTree(xy).query_ball_point(xy, spacing_m * (1 - 1e-9))
    kept = np.zeros(len(xy), np.bool_)
    for row, others in enumerate(near):
        kept[row] = not kept[others].any()
    return np.flatnonzero(kept)


def answers_of(
    similarity: NDArray[np.float32], xy: NDArray[np.float64], street: NDArray[np.int64], *, views: int = 1
) -> PlaceAnswers:
    """The most similar place's position, and the street that most of the ``NEIGHBOURS`` most similar places lie in.

    Args:
        similarity: (queries, places * views), larger is nearer; a query without any finite one gets no answer.
        xy: (places, 2), metres in the map.
        street: (places), classes; of those with equal votes, the one with the nearest neighbour wins.
        views: of each place, next to each other; a place is as similar as its best view.
    """
    of_place = similarity.reshape(len(similarity), len(xy), views).max(axis=2)
    order = np.argsort(-of_place, axis=1, kind="stable")[:, :NEIGHBOURS]
    known = np.isfinite(np.take_along_axis(of_place, order[:, :1], axis=1)[:, 0])
    votes = street[order]
    # A vote is worth a little more the nearer its place, so that a tie falls to the class with the nearest one.
    worth = 1.0 + np.ldexp(1.0, -np.arange(1, votes.shape[1] + 1)) / NEIGHBOURS
    count = np.zeros((len(votes), int(street.max()) + 1))
    for rank in range(votes.shape[1]):
        count[np.arange(len(votes)), votes[:, rank]] += worth[rank]
    return PlaceAnswers(
        np.where(known[:, None], xy[order[:, 0]], np.nan), np.where(known, count.argmax(axis=1), -1).astype(np.int64)
    )
