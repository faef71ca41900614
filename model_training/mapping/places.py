"""Compute the places of a survey, the descriptors of their map views and the points around them, in chunks of places."""

from collections.abc import Callable, Iterable, Set
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model_training.datasets.dataset import Dataset
from model_training.mapping.between import PlacedScan, PlannedPlaces, Viewpoint, at_scan, viewpoint_at
from model_training.mapping.cloud import near
from model_training.mapping.settings import BuildSettings
from model_training.mapping.survey import clear_scan, fan, levelled
from model_training.mapping.tiles import TilePart
from model_training.mapping.voxel_map import VoxelMap
from model_training.mapping.work import Arrays
from service.geometry.rigid import heading_of_body
from service.imaging.view_grid import ViewGrid, fan_planes, panorama_from_points
from service.maps.streets import Streets
from service.retrieval.encoder import Encoder


@dataclass(frozen=True, slots=True, eq=False)
class Places:
    """The places of a survey: first one for each kept scan, in their order, then those between distant scans.

    Attributes:
        T_map_level: pose of the levelled LiDAR at each place (P, 4, 4).
        height_m: height of the LiDAR above the ground, metres (P,).
        heading_rad: heading of each map view, radians, map frame (P, headings).
        descriptors: descriptors of the map views, place by place (P * headings, D).
        sources: indices of the two kept scans that a place is rendered from; equal for a place at a scan (P, 2).
    """

    T_map_level: NDArray[np.float64]
    height_m: NDArray[np.float64]
    heading_rad: NDArray[np.float64]
    descriptors: NDArray[np.float32]
    sources: NDArray[np.int64]

    @property
    def between(self) -> int:
        """Number of places between scans."""
        return int((self.sources[:, 0] != self.sources[:, 1]).sum())

    def rendered_from(self, scans: Set[int]) -> NDArray[np.bool_]:
        """Return whether each place is rendered from any of some scans (P,).

        Args:
            scans: indices of kept scans.
        """
        return np.asarray(np.isin(self.sources, list(scans)).any(axis=1))

    def at_height(self, lidar_height_m: float) -> NDArray[np.float64]:
        """Return the poses (P, 4, 4), moved vertically to one height above the ground.

        Args:
            lidar_height_m: height of every pose above its ground, metres.
        """
        T = self.T_map_level.copy()
        T[:, 2, 3] += lidar_height_m - self.height_m
        return T


@dataclass(frozen=True, eq=False)
class SurveyTraversal:
    """A survey traversal and the settings by which a map is built from it.

    Attributes:
        dataset: the dataset with the scans.
        poses: T_map_lidar of all scans (n, 4, 4).
        kept: indices of the scans that take part, as places or in the cloud (P,).
        settings: settings of the map.
        encoder: encoder of the map views.
        grid: grid of the map views.
        rows_seen: True for the rows of the grid that the map uses (rows,).
        part: the part of the survey that becomes a tile of a tiled map; None for all of it.
    """

    dataset: Dataset
    poses: NDArray[np.float64]
    kept: NDArray[np.int64]
    settings: BuildSettings
    encoder: Encoder
    grid: ViewGrid
    rows_seen: NDArray[np.bool_]
    part: TilePart | None = None

    @cached_property
    def plan(self) -> PlannedPlaces:
        """The places of the traversal."""
        if self.part is not None:
            return self.part.plan
        return PlannedPlaces.of(self.poses[self.kept], self.settings.between_m)

    def chunk(
        self,
        scans: range,
        empty: VoxelMap,
        apart: Set[int] = frozenset(),
        report: Callable[[int], None] = lambda _: None,
    ) -> Arrays:
        """Process some kept scans: level them, render and encode their map views, and gather their points.

        Before a scan that is farther than ``settings.between_m`` from the one before it, it also renders and encodes views between
        both (``mapping.between``). So it reads the scan before the first one too.

        Args:
            scans: indices of kept scans.
            empty: an empty voxel map, whose lattice the points are gathered in.
            apart: indices of the kept scans whose points are left out.
            report: called after every scan with its index plus one.

        Returns:
            The fields of ``Places``, and ``keys`` and ``moments`` of the voxels.
        """
        points = VoxelMap(empty.voxel_m, empty.origin)
        found: list[Arrays] = []
        before: PlacedScan | None = None
        on_way = self.plan.on_way
        for k in range(max(scans.start - 1, 0), scans.stop):
            number = int(self.kept[k])
            scan = clear_scan(self.dataset, number, self.settings)
            # A scan that only gives points, like most around a tile, needs no level.
            placed = None
            if self.plan.at_scan[k] or k in on_way or k + 1 in on_way:
                level = levelled(scan, number, self.settings)
                placed = PlacedScan(level, level.T_map_level(self.poses[number]))
            if k in scans:
                if placed is not None and before is not None:
                    for share in on_way.get(k, ()):
                        found.append(self._encoded(viewpoint_at(before, placed, share), (k - 1, k)))
                if placed is not None and self.plan.at_scan[k]:
                    found.append(self._encoded(at_scan(placed), (k, k)))
                if k not in apart:
                    points.add(*self.cloud_points(scan, self.poses[number]))
                report(k + 1)
            before = placed
        keys, moments = points.sums()
        fields = (
            {name: np.stack([each[name] for each in found]) for name in Places.__slots__} if found else self._none()
        )
        return fields | {"keys": keys, "moments": moments}

    def cloud_points(
        self, points: NDArray[np.float32], T_map_points: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
        """Return the points of a scan that go into the cloud: positions (m, 3), metres, map frame, and intensities (m,).

        Args:
            points: x, y, z (metres, frame of the LiDAR or its level frame) and intensity (n, 4).
            T_map_points: pose of the frame of the points (4, 4).
        """
        positions, intensity = near(points, T_map_points)
        if self.part is None:
            return positions, intensity
        inside = self.part.area.is_in_cloud(positions)
        if inside.all():
            return positions, intensity
        return positions.compress(inside, axis=0), intensity[inside]

    def _none(self) -> Arrays:
        """Return the fields of no place, as ``np.stack`` of those of ``_encoded``."""
        headings = self.settings.headings
        return {
            "T_map_level": np.zeros((0, 4, 4)),
            "height_m": np.zeros(0),
            "heading_rad": np.zeros((0, headings)),
            "descriptors": np.zeros((0, headings, self.encoder.dimension), np.float32),
            "sources": np.zeros((0, 2), np.int64),
        }

    def _encoded(self, viewpoint: Viewpoint, sources: tuple[int, int]) -> Arrays:
        """Return the fields of one place in ``Places``; its descriptors are (headings, D)."""
        turns = fan(self.settings.headings)
        planes = fan_planes(
            panorama_from_points(viewpoint.points, self.grid),
            viewpoint.start_rad + turns,
            sensor_height_m=viewpoint.height_m,
            rows_seen=self.rows_seen,
            grid=self.grid,
        )
        heading_rad = heading_of_body(viewpoint.T_map_level) + viewpoint.start_rad + turns
        return {
            "T_map_level": viewpoint.T_map_level,
            "height_m": np.array(viewpoint.height_m),
            "heading_rad": (heading_rad + np.pi) % (2 * np.pi) - np.pi,
            "descriptors": self.encoder.encode(planes, "survey"),
            "sources": np.array(sources, np.int64),
        }


def _joined(parts: list[NDArray[Any]], row: NDArray[np.int64]) -> NDArray[Any]:
    """Join arrays in another order: the rows of ``row`` (n,). The list becomes empty, so the memory of a part is free when it is copied."""
    whole, done = np.empty((len(row), *parts[0].shape[1:]), parts[0].dtype), 0
    parts.reverse()
    while parts:
        part = parts.pop()
        whole[row[done : done + len(part)]] = part
        done += len(part)
    return whole


def gathered(chunks: Iterable[Arrays], empty: VoxelMap) -> tuple[Places, VoxelMap]:
    """Put the chunks of a traversal together: its places, and the voxel map of its points.

    Args:
        chunks: results of ``SurveyTraversal.chunk``, in order. The order of sums is that of the chunks, so the result is the same to
            the bit.
        empty: the empty voxel map of the chunks.
    """
    cloud, fields = VoxelMap(empty.voxel_m, empty.origin), list[Arrays]()
    for chunk in chunks:
        cloud.add_sums(chunk["keys"], chunk["moments"])
        fields.append({name: chunk[name] for name in Places.__slots__})
    # Merge the sums at this fixed point. The order of single-precision sums changes their last bits, and a later merge depends on
    # whether a site check runs.
    cloud.sums()
    sources = np.concatenate([each["sources"] for each in fields])
    row = np.empty(len(sources), np.int64)
    row[np.argsort(sources[:, 0] != sources[:, 1], kind="stable")] = np.arange(len(sources))  # those at scans first
    whole = {name: _joined([each.pop(name) for each in fields], row) for name in Places.__slots__}
    descriptors = whole.pop("descriptors")
    return Places(**whole, descriptors=descriptors.reshape(-1, descriptors.shape[-1])), cloud


def views_of(places: int, headings: int) -> NDArray[np.int32]:
    """Return the index of the place of each view (V,), fan by fan.

    Args:
        places: number of places.
        headings: number of views per place.
    """
    return np.repeat(np.arange(places, dtype=np.int32), headings)


def streets_of(streets: dict[str, Any] | None, T_map_place: NDArray[np.float64]) -> NDArray[np.int32]:
    """Return the index of the street's feature at each place (P,), -1 for none.

    Args:
        streets: GeoJSON FeatureCollection; None for a map without streets.
        T_map_place: poses of the places (P, 4, 4).
    """
    if streets is None:
        return np.full(len(T_map_place), -1, np.int32)
    polygons = Streets.from_geojson(streets)
    return np.array([polygons.index_at(xy) for xy in T_map_place[:, :2, 3]], np.int32)
