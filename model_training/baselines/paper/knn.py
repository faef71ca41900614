"""The paper's classifier: K nearest neighbours by Euclidean distance over features (2.III, eq. 1)."""

from dataclasses import dataclass

import faiss
import numpy as np
from numpy.typing import NDArray

from model_training.baselines.answers import PlaceAnswers

PAPER_K = 5
KS = tuple(range(1, 22, 2))


@dataclass(frozen=True, eq=False)
class Gallery:
    """What is known: ``features`` (n, d), where each was taken, ``xy`` (n, 2), metres, and its class ``street`` (n)."""

    features: NDArray[np.float32]
    xy: NDArray[np.float64]
    street: NDArray[np.int64]

    def neighbours(self, features: NDArray[np.float32], k: int) -> NDArray[np.int64]:
        """Rows of the k nearest, nearest first, (m, k)."""
        index = faiss.IndexFlatL2(self.features.shape[1])
        index.add(np.ascontiguousarray(self.features))
        found: NDArray[np.int64] = index.search(np.ascontiguousarray(features), k)[1]
        return found

    def answers(self, neighbours: NDArray[np.int64]) -> PlaceAnswers:
        """Majority of the neighbours' classes, ties to the nearer; the position is the nearest one's of that class.

        The paper says how K-NN finds the class, not how a position follows; the nearest frame of the winning class is what
        its "ground true position" can mean, and a mean over several would lie between streets.
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
    """Mean position (classes, 2) of each class, NaN of one without frames: where the softmax, which knows none, is taken to be."""
    centres = np.full((classes, 2), np.nan)
    for each in np.unique(street):
        centres[each] = xy[street == each].mean(axis=0)
    return centres
