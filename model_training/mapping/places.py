"""Compute the places of a survey, the descriptors of their map views and the points around them, in chunks of places."""

from collections.abc import Callable, Set
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model_training.datasets.dataset import Dataset
from model_training.mapping.cloud import near
from model_training.mapping.settings import BuildSettings
from model_training.mapping.survey import fan, fan_views, levelled_scans
from model_training.mapping.voxel_map import VoxelMap
from model_training.mapping.work import Arrays, Work
from service.geometry.rigid import heading_of_body
from service.imaging.view_grid import ViewGrid, survey_planes
from service.maps.streets import Streets
from service.retrieval.encoder import Encoder

#: Number of places whose results are stored as one part.
CHUNK = 64
#: Progress callback: stage, finished steps, all steps.
Report = Callable[[str, int, int], None]


@dataclass(frozen=True, slots=True, eq=False)
class Places:
    """The places of a survey.

    Attributes:
        T_map_level: pose of the levelled LiDAR at each place (P, 4, 4).
        height_m: height of the LiDAR above the ground, metres (P,).
        heading_rad: heading of each map view, radians, map frame (P, headings).
        descriptors: descriptors of the map views, place by place (P * headings, D).
    """

    T_map_level: NDArray[np.float64]
    height_m: NDArray[np.float64]
    heading_rad: NDArray[np.float64]
    descriptors: NDArray[np.float32]

    def at_height(self, lidar_height_m: float) -> NDArray[np.float64]:
        """Return the poses (P, 4, 4), moved vertically to one height above the ground.

        Args:
            lidar_height_m: height of every pose above its ground, metres.
        """
        T = self.T_map_level.copy()
        T[:, 2, 3] += lidar_height_m - self.height_m
        return T


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """A survey traversal and the settings by which a map is built from it.

    Attributes:
        dataset: the dataset with the scans.
        poses: T_map_lidar of all scans (n, 4, 4).
        kept: indices of the scans that become places (P,).
        settings: settings of the map.
        encoder: encoder of the map views.
        grid: grid of the map views.
        rows_seen: True for the rows of the grid that the map uses (rows,).
    """

    dataset: Dataset
    poses: NDArray[np.float64]
    kept: NDArray[np.int64]
    settings: BuildSettings
    encoder: Encoder
    grid: ViewGrid
    rows_seen: NDArray[np.bool_]

    def places(
        self, cloud: VoxelMap, work: Work, *, apart: Set[int] = frozenset(), report: Report = lambda *_: None
    ) -> Places:
        """Process every kept scan: level it, render and encode its map views, and add its points to the cloud.

        Args:
            cloud: the voxel map that the points go into. Chunks are added in order, whether they are computed now or were stored.
            work: store for finished chunks.
            apart: indices of the places whose points stay out of the cloud.
            report: called after every place.
        """
        chunks: list[Arrays] = []
        for first in range(0, len(self.kept), CHUNK):
            chunk = work.part(f"places-{first:07d}", partial(self._chunk, first, cloud, apart, report))
            cloud.add_sums(chunk.pop("keys"), chunk.pop("moments"))
            chunks.append(chunk)
        return Places(*(np.concatenate([chunk[name] for chunk in chunks]) for name in Places.__slots__))

    def _chunk(self, first: int, cloud: VoxelMap, apart: Set[int], report: Report) -> Arrays:
        numbers, turns = self.kept[first : first + CHUNK], fan(self.settings.headings)
        points = VoxelMap(cloud.voxel_m, cloud.origin)
        T_map_level = np.zeros((len(numbers), 4, 4))
        heights, headings, descriptors = np.zeros(len(numbers)), [], []
        for k, scan in enumerate(levelled_scans(self.dataset, numbers, self.settings)):
            T = scan.T_map_level(self.poses[scan.number])
            planes = np.stack([
                survey_planes(view, sensor_height_m=scan.level.height_m, rows_seen=self.rows_seen, grid=self.grid)
                for view in fan_views(scan, turns, self.grid)
            ])  # fmt: skip
            descriptors.append(self.encoder.encode(planes, "survey"))
            headings.append((heading_of_body(T) + scan.start_rad + turns + np.pi) % (2 * np.pi) - np.pi)
            if first + k not in apart:
                points.add(*near(scan.points, T))
            T_map_level[k], heights[k] = T, scan.level.height_m
            report("places", first + k + 1, len(self.kept))
        keys, moments = points.sums()
        return {
            "T_map_level": T_map_level, "height_m": heights, "heading_rad": np.stack(headings),
            "descriptors": np.concatenate(descriptors), "keys": keys, "moments": moments,
        }  # fmt: skip


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
