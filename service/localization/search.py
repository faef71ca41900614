"""From a descriptor to the most similar views, and from views to distinct places."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int32, Int64
from numpy.typing import NDArray

from service.maps.reader import MapBundle


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
        similarities, views = bundle.view_index.search(descriptors, count)
        if len(np.unique(bundle.view_place[views])) >= wanted or views.shape[1] < count:
            return _best_of_turns(bundle, similarities, views, np.array(turns_rad))
        count *= 2


def _best_of_turns(
    bundle: MapBundle,
    similarities: Float32[NDArray[np.float32], "T n"],
    views: Int64[NDArray[np.int64], "T n"],
    turns_rad: Float64[NDArray[np.float64], " T"],
) -> ViewMatches:
    """Every view once, at the turn where it is most similar; the best view first."""
    turn = np.repeat(turns_rad, views.shape[1])
    order = np.argsort(-similarities.reshape(-1), kind="stable")
    flat = views.reshape(-1)[order]
    _, first = np.unique(flat, return_index=True)
    kept = order[np.sort(first)]
    return _matches(bundle, similarities.reshape(-1)[kept], views.reshape(-1)[kept], turn[kept])


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
    return tuple(_neighbour(matches, int(row)) for row in np.sort(first)[:count])


def _neighbour(matches: ViewMatches, row: int) -> Neighbour:
    similarity = float(matches.similarity[row])
    return Neighbour(
        place=int(matches.place[row]),
        similarity=similarity,
        distance=float(np.sqrt(max(0.0, 2.0 - 2.0 * similarity))),
        street=int(matches.street[row]),
        position_m=matches.T_map_place[row, :3, 3].copy(),
        heading_rad=float(matches.heading_rad[row]),
    )
