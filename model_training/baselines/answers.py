"""What every baseline answers: a place on the ground and a street for each query."""

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from service.maps.streets import Streets


@dataclass(frozen=True, slots=True, eq=False)
class PlaceAnswers:
    """A row a query: ``xy`` (n, 2), metres in the map, NaN where nothing was found; ``street`` (n), a class, -1 for none."""

    xy: NDArray[np.float64]
    street: NDArray[np.int64]


def nearest_streets(streets: Streets, xy: NDArray[np.float64]) -> NDArray[np.int64]:
    """The class whose polygon contains each point (n, 2), or else lies nearest to it; -1 for NaN.

    A method that answers a position is not punished for missing a kerb: the nearest street is taken as its answer.
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
