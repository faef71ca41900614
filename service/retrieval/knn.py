"""K-NN in the map: the most similar views, distinct places, and the paper's street vote (section III, figure 2)."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int32, Int64
from numpy.typing import NDArray

from service.maps.map import Map

#: Length of the shortlist, as a multiple of the number of views wanted. Decision 0046 has the loss of a shorter list.
SHORTLIST = 6


@dataclass(frozen=True, slots=True, eq=False)
class ViewMatches:
    """The most similar map views, the best first, one row per view.

    Attributes:
        view: number of the view in the map.
        similarity: cosine similarity of the descriptors.
        place: number of the view's place.
        street: number of the place's street; -1 for none.
        heading_rad: heading of the query by this match, map frame: that of the map view minus the turn of the query view.
        T_map_place: pose of the place's LiDAR.
    """

    view: Int64[NDArray[np.int64], " n"]
    similarity: Float64[NDArray[np.float64], " n"]
    place: Int32[NDArray[np.int32], " n"]
    street: Int32[NDArray[np.int32], " n"]
    heading_rad: Float64[NDArray[np.float64], " n"]
    T_map_place: Float64[NDArray[np.float64], "n 4 4"]

    def __len__(self) -> int:
        return len(self.view)


@dataclass(frozen=True, slots=True, eq=False)
class Neighbour:
    """A retrieved place with its most similar view.

    Attributes:
        place: number of the place in the map.
        similarity: cosine similarity of the descriptors.
        distance: Euclidean distance of the descriptors (paper, equation 1).
        street: number of the street's feature; -1 for none.
        position_m: position of the place's LiDAR, map frame.
        heading_rad: heading of the query by the most similar view, map frame.
    """

    place: int
    similarity: float
    distance: float
    street: int
    position_m: Float64[NDArray[np.float64], "3"]
    heading_rad: float


def search_views(
    bundle: Map,
    descriptors: Float32[NDArray[np.float32], "T D"],
    *,
    turns_rad: tuple[float, ...],
    places: int,
    fewest: int,
) -> ViewMatches:
    """Find the map views that are most similar to any turn of a query.

    The mean descriptor over the turns selects a shortlist from the whole map. Each view of the shortlist is then compared exactly with
    each turn. The shortlist grows until it contains enough places.

    Args:
        bundle: the map.
        descriptors: descriptors of the query views, one row per turn.
        turns_rad: turns of the query views, counter-clockwise against the optical axis, rad. The heading of a match is that of the
            map view minus the turn.
        places: number of distinct places to find, if the map has as many.
        fewest: smallest number of views to find.
    """
    wanted = min(places, len(bundle.places))
    count = max(fewest, 4 * wanted)
    while True:
        shortlist = bundle.view_index.shortlist(descriptors.mean(axis=0), SHORTLIST * count)
        matches = _most_similar(bundle, descriptors, shortlist, np.array(turns_rad), count)
        if len(np.unique(matches.place)) >= wanted or len(shortlist) == len(bundle.view_index):
            return matches
        count *= 2


def _most_similar(
    bundle: Map,
    descriptors: Float32[NDArray[np.float32], "T D"],
    views: Int64[NDArray[np.int64], " n"],
    turns_rad: Float64[NDArray[np.float64], " T"],
    count: int,
) -> ViewMatches:
    """Return the best ``count`` of the given views, the best first, each at its most similar turn."""
    similarities = bundle.view_index.vectors(views) @ descriptors.T
    turn = similarities.argmax(axis=1)
    best = similarities[np.arange(len(views)), turn]
    order = np.argsort(-best, kind="stable")[:count]
    return _matches(bundle, best[order], views[order], turns_rad[turn[order]])


def _matches(
    bundle: Map,
    similarity: Float32[NDArray[np.float32], " n"],
    view: Int64[NDArray[np.int64], " n"],
    turn_rad: Float64[NDArray[np.float64], " n"],
) -> ViewMatches:
    place = np.array(bundle.view_place[view])
    return ViewMatches(
        view=view,
        similarity=similarity.astype(np.float64),
        place=bundle.numbers_of(place),
        street=np.array(bundle.place_street[place]),
        heading_rad=np.array(bundle.view_heading_rad[view]) - turn_rad,
        T_map_place=np.array(bundle.T_map_place[place]),
    )


def distinct_places(matches: ViewMatches, count: int) -> tuple[Neighbour, ...]:
    """Select the most similar distinct places, each with its best view.

    Args:
        matches: most similar map views, the best first.
        count: largest number of places.
    """
    _, first = np.unique(matches.place, return_index=True)
    rows = np.sort(first)[:count]
    similarity = matches.similarity[rows]
    columns = (
        matches.place[rows],
        similarity,
        np.sqrt(np.maximum(0.0, 2.0 - 2.0 * similarity)),
        matches.street[rows],
        matches.heading_rad[rows],
    )
    positions_m = matches.T_map_place[rows, :3, 3]
    return tuple(
        Neighbour(
            place=place,
            similarity=cosine,
            distance=apart,
            street=street,
            position_m=position_m,
            heading_rad=heading_rad,
        )
        for place, cosine, apart, street, heading_rad, position_m in zip(
            *(column.tolist() for column in columns), positions_m, strict=True
        )
    )


def similarity_weights(
    similarities: Float64[NDArray[np.float64], " n"], temperature: float
) -> Float64[NDArray[np.float64], " n"]:
    """Compute softmax weights that sum to 1.

    Contrastive training uses the same softmax, so the similarities are scaled for it.

    Args:
        similarities: cosine similarities, one or more.
        temperature: softmax temperature, in units of similarity.
    """
    weights = np.exp((similarities - similarities.max()) / temperature)
    normalised: Float64[NDArray[np.float64], " n"] = weights / weights.sum()
    return normalised


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
