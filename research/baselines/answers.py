"""The common answer of all baselines: a place on the ground and a street for each query."""

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from service.maps.streets import Streets


@dataclass(frozen=True, slots=True, eq=False)
class PlaceAnswers:
    """Answers of a baseline, one row per query.

    Attributes:
        xy: positions (n, 2), metres, map frame; NaN for no answer.
        street: street classes (n,); -1 for no answer.
    """

    xy: NDArray[np.float64]
    street: NDArray[np.int64]


def nearest_streets(streets: Streets, xy: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the street class that contains or is nearest to each position (n,); -1 for NaN.

    The nearest street counts as the answer, so a position just beyond a kerb is not a street error.

    Args:
        streets: streets of the map.
        xy: positions (n, 2), metres, map frame.
    """
    shapes = [
        shapely.MultiPolygon([shapely.Polygon(rings[0], list(rings[1:])) for rings in street.polygons])
        for street in streets.features
    ]
    found = np.full(len(xy), -1, np.int64)
    known = np.isfinite(xy).all(axis=1)
    distance = np.stack([shapely.distance(shape, shapely.points(xy[known])) for shape in shapes], axis=1)
    found[known] = distance.argmin(axis=1)
    return found
