"""Coverage of the maps as GeoJSON."""

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from service.maps.map import Map

#: Edge of a cell, and largest distance of a robot from a place. Retrieval finds a robot 2 m and slightly more beside a survey's lane.
CELL_M, REACH_M = 5.0, 7.5
_MOST_MADE = 64
_made: dict[tuple[str, str], bytes] = {}


def coverage_geojson(bundles: Sequence[Map]) -> bytes:
    """Return a FeatureCollection with one MultiPolygon per map: the cells near its places.

    Coordinates are longitude and latitude (RFC 7946) if the map is georeferenced, else metres of the map frame. The property
    ``frame`` names the frame.

    Args:
        bundles: the maps.
    """
    return b'{"type": "FeatureCollection", "features": [' + b", ".join(_feature(bundle) for bundle in bundles) + b"]}"


def _feature(bundle: Map) -> bytes:
    """Return the feature of a map, computed once per version. A large map takes seconds."""
    name = (str(bundle.path), bundle.manifest.version)
    if name not in _made:
        while len(_made) >= _MOST_MADE:
            _made.pop(next(iter(_made)))
        _made[name] = json.dumps(_made_feature(bundle)).encode()
    return _made[name]


def _made_feature(bundle: Map) -> dict[str, Any]:
    rings = [_ring(rectangle, bundle) for rectangle in covered(bundle.T_map_place[:, :2, 3])]
    return {
        "type": "Feature",
        "properties": {
            "map": bundle.name,
            "version": bundle.manifest.version,
            "frame": "map" if bundle.earth is None else "wgs84",
            "places": bundle.manifest.counts.places,
            "reach_m": REACH_M,
        },
        "geometry": {"type": "MultiPolygon", "coordinates": [[ring] for ring in rings]},
    }


def covered(places_m: Float64[NDArray[np.float64], "P 2"]) -> list[tuple[float, float, float, float]]:
    """Return rectangles (x0, y0, x1, y1), metres, that cover the cells with their centre within ``REACH_M`` of a place.

    A run of adjacent cells along x is one rectangle.

    Args:
        places_m: positions of the places, map frame, metres.
    """
    steps = np.arange(-np.ceil(REACH_M / CELL_M), np.ceil(REACH_M / CELL_M) + 1)
    around = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    cells = np.floor(places_m / CELL_M)[:, None] + around
    near = np.linalg.norm((cells + 0.5) * CELL_M - places_m[:, None], axis=2) <= REACH_M
    found = np.unique(cells[near].astype(np.int64), axis=0)
    found = found[np.lexsort((found[:, 0], found[:, 1]))]  # row by row, x rising
    breaks = np.flatnonzero((np.diff(found[:, 0]) != 1) | (np.diff(found[:, 1]) != 0)) + 1
    return [
        (
            CELL_M * float(run[0, 0]),
            CELL_M * float(run[0, 1]),
            CELL_M * float(run[-1, 0] + 1),
            CELL_M * float(run[0, 1] + 1),
        )
        for run in np.split(found, breaks)
        if len(run)
    ]


def _ring(rectangle: tuple[float, float, float, float], bundle: Map) -> list[list[float]]:
    """Return the closed ring of a rectangle, counter-clockwise."""
    x0, y0, x1, y1 = rectangle
    corners = [(x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0)]
    earth = bundle.earth
    if earth is None:
        return [list(corner) for corner in corners]
    on_earth = [earth.to_earth(np.array([x, y, 0.0])) for x, y in corners]
    return [[round(longitude, 8), round(latitude, 8)] for latitude, longitude, _ in on_earth]
