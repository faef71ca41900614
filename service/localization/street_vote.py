"""The paper's K-NN classifier: the nearest places vote for the street (section III, figure 2)."""

from dataclasses import dataclass

import numpy as np

from service.localization.hypotheses import similarity_weights
from service.localization.search import Neighbour


@dataclass(frozen=True, slots=True)
class StreetVote:
    """How the neighbours voted.

    Attributes:
        street: number of the winning street's feature; -1 where most of the weight lies in no street.
        share: the winner's share of the similarity weights.
        shares: street and share of every street that got a vote, the largest first; -1 is "in no street".
    """

    street: int
    share: float
    shares: tuple[tuple[int, float], ...]


def vote(neighbours: tuple[Neighbour, ...], temperature: float) -> StreetVote:
    """Let distinct places vote, each with the weight of its similarity.

    Args:
        neighbours: the k nearest, one or more.
        temperature: as in ``ClusterSettings``.
    """
    weights = similarity_weights(np.array([each.similarity for each in neighbours]), temperature)
    shares: dict[int, float] = {}
    for neighbour, weight in zip(neighbours, weights, strict=True):
        shares[neighbour.street] = shares.get(neighbour.street, 0.0) + float(weight)
    ranked = tuple(sorted(shares.items(), key=lambda item: -item[1]))
    return StreetVote(street=ranked[0][0], share=ranked[0][1], shares=ranked)
