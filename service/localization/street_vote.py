"""The paper's K-NN classifier: the nearest places vote for the street (section III, figure 2)."""

from dataclasses import dataclass

import numpy as np

from service.localization.hypotheses import similarity_weights
from service.localization.search import Neighbour


@dataclass(frozen=True, slots=True)
class StreetVote:
    """Result of the street vote.

    Attributes:
        street: number of the winning street's feature; -1 if "in no street" wins.
        share: share of the similarity weights of the winner, 0 to 1.
        shares: number and share of every street with a vote, the largest share first; -1 is "in no street".
    """

    street: int
    share: float
    shares: tuple[tuple[int, float], ...]


def vote(neighbours: tuple[Neighbour, ...], temperature: float) -> StreetVote:
    """Vote for the street among distinct places, weighted by the softmax of their similarity.

    Args:
        neighbours: the k nearest places, one or more.
        temperature: softmax temperature, as in ``ClusterSettings``.
    """
    weights = similarity_weights(np.array([each.similarity for each in neighbours]), temperature)
    shares: dict[int, float] = {}
    for neighbour, weight in zip(neighbours, weights, strict=True):
        shares[neighbour.street] = shares.get(neighbour.street, 0.0) + float(weight)
    ranked = tuple(sorted(shares.items(), key=lambda item: -item[1]))
    return StreetVote(street=ranked[0][0], share=ranked[0][1], shares=ranked)
