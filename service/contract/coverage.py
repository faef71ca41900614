"""Where maps can answer, as GeoJSON."""

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from service.maps.reader import MapBundle

#: Edge of a cell, and how far from a place a robot may stand: retrieval finds it 2 m aside of a survey's lane, and a little more.
CELL_M, REACH_M = 5.0, 7.5
_MOST_MADE = 64
_made: dict[tuple[str, str], bytes] = {}


def coverage_geojson(bundles: Sequence[MapBundle]) -> bytes:
    """A FeatureCollection with a MultiPolygon of each map: its places and what lies near them.

    Longitude and latitude where the map is georeferenced, as RFC 7946 has it, else metres of the map frame, which the property
    ``frame`` says.
    """
    return b'{"type": "FeatureCollection", "features": [' + b", ".join(_feature(bundle) for bundle in bundles) + b"]}"


def _feature(bundle: MapBundle) -> bytes:
    """Made once for each version of a map: of a large one it takes seconds."""
    name = (str(bundle.path), bundle.manifest.version)
    if name not in _made:
        while len(_made) >= _MOST_MADE:
            _made.pop(next(iter(_made)))
        _made[name] = json.dumps(_made_feature(bundle)).encode()
    return _made[name]


def _made_feature(bundle: MapBundle) -> dict[str, Any]:
    rings = [_ring(rectangle, bundle) for rectangle in covered(bundle.T_map_place[:, :2, 3])]
    return {
        "type": "Feature",
        "properties": {
            "map": bundle.name, "version": bundle.manifest.version, "frame": "map" if bundle.earth is None else "wgs84",
            "places": bundle.manifest.counts.places, "reach_m": REACH_M,
        },
        "geometry": {"type": "MultiPolygon", "coordinates": [[ring] for ring in rings]},
    }  # fmt: skip


def covered(places_m: Float64[NDArray[np.float64], "P 2"]) -> list[tuple[float, float, float, float]]:
    """Rectangles (x0, y0, x1, y1) of cells whose centre lies within reach of a place, runs of cells along x as one."""
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


def _ring(rectangle: tuple[float, float, float, float], bundle: MapBundle) -> list[list[float]]:
    """Counter-clockwise and closed."""
    x0, y0, x1, y1 = rectangle
    corners = [(x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0)]
    earth = bundle.earth
    if earth is None:
        return [list(corner) for corner in corners]
    on_earth = [earth.to_earth(np.array([x, y, 0.0])) for x, y in corners]
    return [[round(longitude, 8), round(latitude, 8)] for latitude, longitude, _ in on_earth]
