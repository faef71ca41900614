"""Coverage of the maps as GeoJSON."""

import json
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64
from numpy.typing import NDArray

from service.geometry.earth import Georeference
from service.maps.map import Map
from service.runtime.admission import MIB, Hold

#: Edge of a cell, and largest distance of a robot from a place. Retrieval finds a robot 2 m and slightly more beside a survey's lane.
CELL_M, REACH_M = 5.0, 7.5
#: Places, and rectangles, that are worked on at once.
BLOCK = 4096
#: Memory for the work on one block, bytes. Measured: 8 MiB.
WORK_BYTES = 16 * MIB
#: Bound of all features that this process keeps, bytes.
KEPT_BYTES = 32 * MIB

#: A cell is one number: its column, plus its row times this number. A place lies within 10,000 km of the origin, so columns are smaller.
_ROW = 2**32
#: Memory of a covered cell while cells are joined and become rectangles, bytes.
_CELL_BYTES = 32
_BEFORE, _AFTER = b'{"type": "FeatureCollection", "features": [', b"]}"


class _Feature:
    """The feature of a map version as JSON. A hold may belong to it, so it supports weak references."""

    def __init__(self, data: bytes) -> None:
        self.data = data


_kept: OrderedDict[tuple[str, str], _Feature] = OrderedDict()
_making = threading.Lock()


def coverage_geojson(bundles: Sequence[Map], hold: Hold) -> bytes:
    """Return a FeatureCollection with one MultiPolygon per map: the cells near its places.

    Coordinates are longitude and latitude (RFC 7946) if the map is georeferenced, else metres of the map frame. The property
    ``frame`` names the frame. The feature of a version is computed once and kept, if it is not larger than ``KEPT_BYTES``.

    Args:
        bundles: the maps.
        hold: memory of the request, empty. It has the bytes of the answer afterwards.

    Raises:
        BusyError: other requests hold too much memory now.
        TooLargeError: the service has too little memory for these maps.
    """
    features = [_feature(bundle, hold) for bundle in bundles]
    hold.grow(2 * sum(len(each.data) + 2 for each in features))
    collection = _BEFORE + b", ".join(each.data for each in features) + _AFTER
    hold.shrink_to(len(collection))
    return collection


def _feature(bundle: Map, hold: Hold) -> _Feature:
    """Return the feature of a map. A large map takes a second, so other requests wait for it instead of computing it too."""
    name = (str(bundle.path), bundle.manifest.version)
    with _making:
        if name in _kept:
            _kept.move_to_end(name)
            return _kept[name]
        before = hold.bytes
        feature = _Feature(b"".join(_pieces(bundle, hold)))
        hold.shrink_to(before + len(feature.data))
        if len(feature.data) <= KEPT_BYTES:
            _keep(name, feature, hold)
        return feature


def _keep(name: tuple[str, str], feature: _Feature, hold: Hold) -> None:
    """Keep a feature instead of those that were used least recently."""
    while _kept and sum(len(each.data) for each in _kept.values()) + len(feature.data) > KEPT_BYTES:
        _kept.popitem(last=False)
    _kept[name] = feature
    hold.leave_with(feature, len(feature.data))


def _pieces(bundle: Map, hold: Hold) -> Iterator[bytes]:
    """Yield the parts of a map's feature, and reserve the memory for them and for joining them."""
    hold.grow(WORK_BYTES)
    properties: dict[str, Any] = {
        "map": bundle.name,
        "version": bundle.manifest.version,
        "frame": "map" if bundle.earth is None else "wgs84",
        "places": bundle.manifest.counts.places,
        "reach_m": REACH_M,
    }
    rectangles = covered(bundle.places_xy.T, hold.grow)
    start = f'{{"type": "Feature", "properties": {json.dumps(properties)}, '
    yield f'{start}"geometry": {{"type": "MultiPolygon", "coordinates": ['.encode()
    for first in range(0, len(rectangles), BLOCK):
        rings = _rings(rectangles[first : first + BLOCK], bundle.earth)
        piece = (", " if first else "").encode() + json.dumps(rings[:, None].tolist())[1:-1].encode()
        hold.grow(2 * len(piece))
        yield piece
    yield b"]}}"


def covered(
    places_m: Float64[NDArray[np.float64], "P 2"], grow: Callable[[int], None] = lambda _: None
) -> Float64[NDArray[np.float64], "n 4"]:
    """Return rectangles (x0, y0, x1, y1), metres, that cover the cells with their centre within ``REACH_M`` of a place.

    A run of adjacent cells along x is one rectangle. Besides ``WORK_BYTES``, the memory depends on the area and not on the number of
    places.

    Args:
        places_m: positions of the places, map frame, metres.
        grow: called with a number of bytes before they are needed for the area. It may raise.
    """
    steps = np.arange(-np.ceil(REACH_M / CELL_M), np.ceil(REACH_M / CELL_M) + 1)
    around = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    found, new, reserved = np.empty(0, np.int64), list[Int64[NDArray[np.int64], " n"]](), 0
    for first in range(0, len(places_m), BLOCK):
        block_m = places_m[first : first + BLOCK]
        cells = np.floor(block_m / CELL_M)[:, None] + around
        near = np.linalg.norm((cells + 0.5) * CELL_M - block_m[:, None], axis=2) <= REACH_M
        new.append(np.unique(cells[near].astype(np.int64) @ [1, _ROW]))
        waiting = sum(map(len, new))
        if waiting < len(found) and first + BLOCK < len(places_m):  # joining seldom keeps the time for sorting small
            continue
        needed = _CELL_BYTES * (len(found) + waiting)
        if needed > reserved:
            grow(needed - reserved)
            reserved = needed
        found, new = np.unique(np.concatenate([found, *new])), []
    if not len(found):
        return np.empty((0, 4))
    breaks = np.flatnonzero(np.diff(found) != 1) + 1
    starts, ends = found[np.r_[0, breaks]], found[np.r_[breaks, len(found)] - 1]
    rows = (starts + _ROW // 2) // _ROW
    columns = np.column_stack([starts, rows, ends + 1, rows + 1])
    columns[:, [0, 2]] -= _ROW * rows[:, None]
    return CELL_M * columns.astype(np.float64)


def _rings(
    rectangles_m: Float64[NDArray[np.float64], "n 4"], earth: Georeference | None
) -> Float64[NDArray[np.float64], "n 5 2"]:
    """Return the closed rings of rectangles, counter-clockwise: metres, or longitude and latitude to about 1 mm."""
    corners_m = rectangles_m[:, [[0, 1], [2, 1], [2, 3], [0, 3], [0, 1]]]
    if earth is None:
        return corners_m
    xyz_m = np.concatenate([corners_m, np.zeros((*corners_m.shape[:2], 1))], axis=2)
    rings: Float64[NDArray[np.float64], "n 5 2"] = np.round(earth.to_earth_all(xyz_m)[..., [1, 0]], 8)
    return rings
