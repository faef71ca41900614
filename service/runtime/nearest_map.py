"""Choose a map by a position on the Earth, for requests that name no map."""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from service.localization.localizer import Localizer
from service.maps.map import Map


def nearest_map(localizers: Iterable[Localizer], latitude_deg: float, longitude_deg: float) -> Localizer | None:
    """Return the localizer of the map with the place that is nearest to a position; None if no map is georeferenced.

    No distance is too large. A robot outside of all maps gets an answer of the nearest one, and this answer is OUT_OF_MAP.

    Args:
        localizers: one for each map. Those without a georeference do not count.
        latitude_deg: geodetic latitude, degrees.
        longitude_deg: longitude, degrees.
    """
    found = list[tuple[float, Localizer, Float64[NDArray[np.float64], "3"]]]()
    for localizer in localizers:
        if (earth := localizer.bundle.earth) is not None:
            xyz_m = earth.to_map(latitude_deg, longitude_deg, earth.height_m)
            found.append((_to_extent_m(localizer.bundle, xyz_m), localizer, xyz_m))
    found.sort(key=lambda each: each[0])
    nearest, nearest_m = None, np.inf
    for least_m, localizer, xyz_m in found:
        if least_m >= nearest_m:  # neither this map nor a following one has a place that is nearer
            break
        distance_m = _to_places_m(localizer.bundle, xyz_m)
        if distance_m < nearest_m:
            nearest, nearest_m = localizer, distance_m
    return nearest


# z counts too: seen from a map, a position on the other side of the Earth has a small x and y, and lies far below.


def _to_extent_m(bundle: Map, xyz_m: Float64[NDArray[np.float64], "3"]) -> float:
    """Return a distance that no place of the map is nearer than."""
    least, most = bundle.extent_m
    outside = np.maximum(0.0, np.maximum(least - xyz_m[:2], xyz_m[:2] - most))
    return float(np.linalg.norm([*outside, xyz_m[2]]))


def _to_places_m(bundle: Map, xyz_m: Float64[NDArray[np.float64], "3"]) -> float:
    x, y = bundle.places_xy
    square = (x - xyz_m[0]) ** 2 + (y - xyz_m[1]) ** 2
    return float(np.hypot(np.sqrt(square.min()), xyz_m[2]))
