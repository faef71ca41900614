"""Choose a map by a position on the Earth, for requests that name no map."""

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from service.localization.localizer import Localizer


@dataclass(frozen=True, slots=True, eq=False)
class MapOnEarth:
    """A map, and what it takes to measure how far away it is.

    Attributes:
        localizer: of the map.
        extent_m: the least and the largest x and y of its places, map frame, metres.
    """

    localizer: Localizer
    extent_m: Float64[NDArray[np.float64], "2 2"] = field(init=False)

    def __post_init__(self) -> None:
        xy_m = self.localizer.bundle.places_xy
        object.__setattr__(self, "extent_m", np.stack([xy_m.min(axis=1), xy_m.max(axis=1)]))

    # z counts too: seen from a map, a position on the other side of the Earth has a small x and y, and lies far below.

    def least_distance_m(self, xyz_m: Float64[NDArray[np.float64], "3"]) -> float:
        """Return a distance that no place is nearer than, metres.

        Args:
            xyz_m: the position, map frame, metres.
        """
        least_m, most_m = self.extent_m
        outside_m = np.maximum(0.0, np.maximum(least_m - xyz_m[:2], xyz_m[:2] - most_m))
        return float(np.linalg.norm([*outside_m, xyz_m[2]]))

    def distance_m(self, xyz_m: Float64[NDArray[np.float64], "3"]) -> float:
        """Return the distance of the nearest place, metres.

        Args:
            xyz_m: the position, map frame, metres.
        """
        x_m, y_m = self.localizer.bundle.places_xy
        square = (x_m - xyz_m[0]) ** 2 + (y_m - xyz_m[1]) ** 2
        return float(np.hypot(np.sqrt(square.min()), xyz_m[2]))


def nearest_map(maps: Iterable[MapOnEarth], latitude_deg: float, longitude_deg: float) -> Localizer | None:
    """Return the localizer of the map with the place that is nearest to a position; None if no map is georeferenced.

    No distance is too large. A robot outside of all maps gets an answer of the nearest one, and this answer is OUT_OF_MAP.

    Args:
        maps: those without a georeference do not count.
        latitude_deg: geodetic latitude, degrees.
        longitude_deg: longitude, degrees.
    """
    found = list[tuple[float, MapOnEarth, Float64[NDArray[np.float64], "3"]]]()
    for each in maps:
        if (earth := each.localizer.bundle.earth) is not None:
            xyz_m = earth.to_map(latitude_deg, longitude_deg, earth.height_m)
            found.append((each.least_distance_m(xyz_m), each, xyz_m))
    found.sort(key=lambda of_map: of_map[0])
    nearest, nearest_m = None, np.inf
    for least_m, each, xyz_m in found:
        if least_m >= nearest_m:  # neither this map nor a following one has a place that is nearer
            break
        if (distance_m := each.distance_m(xyz_m)) < nearest_m:
            nearest, nearest_m = each.localizer, distance_m
    return nearest
