"""The paper's classifier: K nearest neighbours by Euclidean distance of features (2.III, eq. 1)."""

from dataclasses import dataclass

import faiss
import numpy as np
from numpy.typing import NDArray

from research.baselines.answers import PlaceAnswers

PAPER_K = 5
KS = tuple(range(1, 22, 2))


@dataclass(frozen=True, eq=False)
class Gallery:
    """Known samples.

    Attributes:
        features: features (n, d).
        xy: positions (n, 2), metres, map frame.
        street: street classes (n,).
    """

    features: NDArray[np.float32]
    xy: NDArray[np.float64]
    street: NDArray[np.int64]

    def neighbours(self, features: NDArray[np.float32], k: int) -> NDArray[np.int64]:
        """Return the rows (m, k) of the k nearest samples, nearest first.

        Args:
            features: features of the queries (m, d).
            k: number of neighbours.
        """
        index = faiss.IndexFlatL2(self.features.shape[1])
        index.add(np.ascontiguousarray(self.features))
        found: NDArray[np.int64] = index.search(np.ascontiguousarray(features), k)[1]
        return found

    def answers(self, neighbours: NDArray[np.int64]) -> PlaceAnswers:
        """Answer the majority class of the neighbours, ties to the nearer, and the position of its nearest neighbour.

        The paper describes how K-NN finds the class, but not how a position follows. The nearest frame of the winning
        class is a possible meaning of its "ground true position". A mean over several frames would lie between streets.

        Args:
            neighbours: rows of the neighbours (m, k), nearest first.
        """
        classes = self.street[neighbours]
        won, at = np.empty(len(classes), np.int64), np.empty(len(classes), np.int64)
        for row, voted in enumerate(classes):
            count = np.bincount(voted)
            tied = np.flatnonzero(count == count.max())
            first = next(k for k, each in enumerate(voted) if each in tied)
            won[row], at[row] = voted[first], neighbours[row, first]
        return PlaceAnswers(self.xy[at], won)


def class_centres(xy: NDArray[np.float64], street: NDArray[np.int64], classes: int) -> NDArray[np.float64]:
    """Return the mean position (classes, 2) of each class, NaN for an empty class.

    The softmax gives no position, so this mean is its answer.

    Args:
        xy: positions (n, 2), metres, map frame.
        street: street classes (n,).
        classes: number of classes.
    """
    centres = np.full((classes, 2), np.nan)
    for each in np.unique(street):
        centres[each] = xy[street == each].mean(axis=0)
    return centres
