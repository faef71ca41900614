"""Serialize the cloud and the survey track of a map, small enough for a browser."""

import struct
import threading
from collections import OrderedDict

import numpy as np
from numpy.typing import NDArray

from service.maps.map import Map
from service.registration.surfel_map import SurfelMap
from service.registration.surfel_tiles import DRAWN_TILES, Cloud

#: ``points`` is rounded down to one of these, so that few clouds are computed and kept.
LEVELS = (20_000, 50_000, 100_000, 200_000, 500_000, 1_000_000, 2_000_000)
_KEPT = 2
CLOUD_MAGIC, PLACES_MAGIC = b"SFC1", b"SFP1"
#: x, y, z in steps of the header, and how upright the surface is: 0 flat ground, 65535 a wall.
_POINT = np.dtype([("xyz", "<u2", (3,)), ("upright", "<u2")])
_PLACE = np.dtype([("xyz", "<f4", (3,)), ("heading_rad", "<f4"), ("street", "<i4")])
_STEPS = 65535


class Clouds:
    """Cache of serialized clouds. A large map takes a second. Safe to call from several threads."""

    def __init__(self) -> None:
        self._made: OrderedDict[tuple[str, str, int], bytes] = OrderedDict()
        self._making = threading.Lock()

    def of(self, bundle: Map, points: int) -> bytes:
        """Return ``cloud_bytes`` of a map, from the cache if possible.

        Args:
            bundle: the map.
            points: most points; rounded down to one of ``LEVELS``.
        """
        level = max((each for each in LEVELS if each <= points), default=LEVELS[0])
        name = (str(bundle.path), bundle.manifest.version, level)
        with self._making:  # two browsers that open at once wait for the same cloud
            if name not in self._made:
                self._made[name] = cloud_bytes(bundle.cloud, level)
            self._made.move_to_end(name)
            while len(self._made) > _KEPT:
                self._made.popitem(last=False)
            return self._made[name]


def cloud_bytes(cloud: Cloud | None, most: int) -> bytes:
    """Return the points of a cloud, thinned evenly over the ground. Any first part of them is a thinner cloud.

    Format: ``SFC1``, count (uint32), origin and step (float64 x 3 each, metres, map frame), then one ``_POINT`` per point. All numbers
    are little-endian.

    Args:
        cloud: cloud of a map; None for a map without a cloud.
        most: most points.
    """
    parts = () if cloud is None else cloud.parts(DRAWN_TILES)
    if not any(len(part.surfels) for part in parts):
        return CLOUD_MAGIC + struct.pack("<I6d", 0, *(0.0,) * 3, *(1.0,) * 3)
    origin_m, xyz, upright = parts[0].origin_m, [], []
    for part in parts:
        chosen = part.unpacked(thinned(part, most // len(parts)))
        xyz.append(chosen["xyz"] if part is parts[0] else chosen["xyz"] + (part.origin_m - origin_m))
        upright.append(_STEPS * (1.0 - np.clip(np.abs(chosen["normal"][:, 2]), 0, 1)))
    positions = np.concatenate(xyz)
    rows = np.random.default_rng(0).permutation(len(positions))
    low = positions.min(axis=0).astype(np.float64)
    step = np.maximum((positions.max(axis=0) - low) / _STEPS, 1e-6)
    packed = np.empty(len(rows), _POINT)
    packed["xyz"] = np.clip(np.rint((positions[rows] - low) / step), 0, _STEPS)
    packed["upright"] = np.rint(np.concatenate(upright)[rows])
    return CLOUD_MAGIC + struct.pack("<I6d", len(rows), *(origin_m + low), *step) + packed.tobytes()


def thinned(cloud: SurfelMap, most: int) -> NDArray[np.intp]:
    """Return rows of surfels with an even density: one surfel of each cell of a lattice.

    It works region by region of the grid, so a map may be larger than the memory.

    Args:
        cloud: surfel map.
        most: most rows.
    """
    surfels, cubes = cloud.surfels, cloud.grid.cubes
    if len(surfels) <= most:
        return np.arange(len(surfels))
    # Surfaces are two-dimensional, so half of the points need a cell that is larger by the square root of two.
    cell_m = _spacing_m(cloud) * float(np.sqrt(len(surfels) / most))
    kept = []
    for first, count in zip(cubes["first"].tolist(), cubes["count"].tolist(), strict=True):
        if not count:
            continue
        cell = np.floor(cloud.unpacked(slice(first, first + count))["xyz"] / cell_m).astype(np.int64)
        cell -= cell.min(axis=0, initial=0)
        across = cell.max(axis=0, initial=0) + 1
        key = (cell[:, 0] * across[1] + cell[:, 1]) * across[2] + cell[:, 2]
        rows = first + np.sort(np.unique(key, return_index=True)[1])
        share = int(most * count / len(surfels))
        kept.append(rows if len(rows) <= share else rows[np.linspace(0, len(rows) - 1, share).astype(np.intp)])
    return np.concatenate(kept)


def _spacing_m(cloud: SurfelMap) -> float:
    """Return the spacing of neighbouring surfels in the fullest region, m: the edge of a cell with about one surfel."""
    _, first, count = cloud.grid.cubes[int(np.argmax(cloud.grid.cubes["count"]))].item()
    xyz = cloud.unpacked(slice(first, first + count))["xyz"]
    for cell_m in (0.1, 0.2, 0.3, 0.4, 0.6, 0.8):
        occupied = len(np.unique(np.floor(xyz / cell_m).astype(np.int32), axis=0))
        if occupied < 0.8 * count:
            return cell_m
    return 1.0


def places_bytes(bundle: Map) -> bytes:
    """Return the places of the survey.

    Format: ``SFP1``, count (uint32), origin (float64 x 3, metres, map frame), then one ``_PLACE`` per place, all little-endian.
    """
    T = bundle.T_map_place
    origin_m = T[:, :3, 3].mean(axis=0)
    packed = np.empty(len(T), _PLACE)
    packed["xyz"] = T[:, :3, 3] - origin_m
    packed["heading_rad"] = np.arctan2(T[:, 1, 0], T[:, 0, 0])
    packed["street"] = bundle.place_street
    return PLACES_MAGIC + struct.pack("<I3d", len(T), *origin_m) + packed.tobytes()
