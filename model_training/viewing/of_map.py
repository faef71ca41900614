"""A map bundle as events: cloud, places and streets."""

from collections.abc import Iterator

import numpy as np

from model_training.viewing.events import Cloud, Event, Outlines, Track
from service.maps.map import Map
from service.maps.streets import Streets
from service.registration.surfel_tiles import DRAWN_TILES


def events_of_map(bundle: Map, *, most_points: int) -> Iterator[Event]:
    """Yield the map's events, all of them always visible.

    Args:
        bundle: the map.
        most_points: largest number of points; a larger cloud shows each n-th surfel.
    """
    drawn = () if bundle.cloud is None else bundle.cloud.parts(DRAWN_TILES)
    for number, part in enumerate(drawn):
        surfels = part.unpacked(np.s_[:: max(1, -(-len(part.surfels) * len(drawn) // most_points))])
        upright = 1 - np.abs(surfels["normal"][:, 2])
        yield Cloud(
            "map/cloud" if len(drawn) == 1 else f"map/cloud/{number}",
            None,
            part.origin_m,
            surfels["xyz"],
            (90 + 150 * upright).astype(np.uint8),
        )
    yield Track("map/places", None, bundle.T_map_place[:, :3, 3])
    if bundle.streets is not None and bundle.earth is None:
        ground_m = float(np.median(bundle.T_map_place[:, 2, 3])) - bundle.manifest.lidar_height_m
        yield outlines_of(bundle.streets, ground_m)


def outlines_of(streets: Streets, ground_m: float) -> Outlines:
    """Return the outer rings of streets at a height.

    Args:
        streets: streets in map metres.
        ground_m: height of the rings, metres, map frame.
    """
    named = [(street.name, rings[0]) for street in streets.features for rings in street.polygons]
    flat = tuple(np.column_stack([ring, np.full(len(ring), ground_m)]) for _, ring in named)
    return Outlines("map/streets", None, tuple(name for name, _ in named), flat)
