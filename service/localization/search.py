"""From a descriptor to the most similar views, and from views to distinct places."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int32, Int64
from numpy.typing import NDArray

from service.maps.reader import MapBundle

#: The list is so many times as long as what is wanted from it (decision log: what a shorter one loses).
SHORTLIST = 6


@dataclass(frozen=True, slots=True, eq=False)
class ViewMatches:
    """The most similar views, the best first, with what the map knows of each."""

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
    """A place among the nearest, with its most similar view.

    Attributes:
        place: number of the place in the map.
        similarity: cosine of the descriptors.
        distance: Euclidean distance of the descriptors (the paper's, equation 1).
        street: number of the street's feature; -1 for none.
        position_m: of the place's LiDAR, map frame.
        heading_rad: of the view, map frame.
    """

    place: int
    similarity: float
    distance: float
    street: int
    position_m: Float64[NDArray[np.float64], "3"]
    heading_rad: float


def search_views(
    bundle: MapBundle,
    descriptors: Float32[NDArray[np.float32], "T D"],
    *,
    turns_rad: tuple[float, ...],
    places: int,
    fewest: int,
) -> ViewMatches:
    """The views that are most similar to any of a query's turned views.

    The mean of the turned descriptors picks a list from the whole map, and what is on it is compared with each.

    Args:
        bundle: the map.
        descriptors: of the turned views.
        turns_rad: of the same; a match's heading is that of the map's view less the turn.
        places: so many distinct places are wanted, if the map has them.
        fewest: so many views at least.
    """
    wanted = min(places, bundle.manifest.counts.places)
    count = max(fewest, 4 * wanted)
    while True:
        shortlist = bundle.view_index.shortlist(descriptors.mean(axis=0), SHORTLIST * count)
        matches = _most_similar(bundle, descriptors, shortlist, np.array(turns_rad), count)
        if len(np.unique(matches.place)) >= wanted or len(shortlist) == len(bundle.view_index):
            return matches
        count *= 2


def _most_similar(
    bundle: MapBundle,
    descriptors: Float32[NDArray[np.float32], "T D"],
    views: Int64[NDArray[np.int64], " n"],
    turns_rad: Float64[NDArray[np.float64], " T"],
    count: int,
) -> ViewMatches:
    """The best ``count`` of some views, each at the turn where it is most similar; the best first."""
    similarities = bundle.view_index.vectors(views) @ descriptors.T
    turn = similarities.argmax(axis=1)
    best = similarities[np.arange(len(views)), turn]
    order = np.argsort(-best, kind="stable")[:count]
    return _matches(bundle, best[order], views[order], turns_rad[turn[order]])


def _matches(
    bundle: MapBundle,
    similarity: Float32[NDArray[np.float32], " n"],
    view: Int64[NDArray[np.int64], " n"],
    turn_rad: Float64[NDArray[np.float64], " n"],
) -> ViewMatches:
    place = np.array(bundle.view_place[view])
    return ViewMatches(
        view=view,
        similarity=similarity.astype(np.float64),
        place=place,
        street=np.array(bundle.place_street[place]),
        heading_rad=np.array(bundle.view_heading_rad[view]) - turn_rad,
        T_map_place=np.array(bundle.T_map_place[place]),
    )


def distinct_places(matches: ViewMatches, count: int) -> tuple[Neighbour, ...]:
    """The ``count`` most similar places, each by its best view."""
    _, first = np.unique(matches.place, return_index=True)
    rows = np.sort(first)[:count]
    similarity = matches.similarity[rows]
    columns = (
        matches.place[rows], similarity, np.sqrt(np.maximum(0.0, 2.0 - 2.0 * similarity)), matches.street[rows],
        matches.heading_rad[rows],
    )  # fmt: skip
    positions_m = matches.T_map_place[rows, :3, 3]
    return tuple(
        Neighbour(
            place=place, similarity=alike, distance=apart, street=street, position_m=position_m, heading_rad=heading_rad
        )
        for place, alike, apart, street, heading_rad, position_m in zip(
            *(column.tolist() for column in columns), positions_m, strict=True
        )
    )
