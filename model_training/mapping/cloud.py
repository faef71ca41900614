"""Compute the cloud of a map: from the points of the scans to the content of a bundle."""

from dataclasses import replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from model_training.mapping.preview import preview_webp
from model_training.mapping.voxel_map import VoxelMap
from service.geometry.lengths import lengths
from service.geometry.rigid import transform_points
from service.heap import trim
from service.maps.content import BundleContent
from service.registration.surfel_map import SurfelMap

#: Largest range of a point in the cloud, metres.
CLOUD_REACH_M = 40.0
#: Name of the parameter with the height up to which the survey saw surfaces, metres above the ground.
SURVEYED_HEIGHT = "surveyed_height_m"
#: This share of the surfels above ``_GROUND_M`` lies lower than ``_RIM_M`` below the surveyed height. The rim keeps the upper edges of
#: walls, and allows for errors of the level. Surfels farther than ``_BESIDE_M`` from the places do not count, because the ground there
#: may have another height. At most ``_MOST_SURFELS`` count.
_SURVEYED_SHARE, _RIM_M, _GROUND_M, _BESIDE_M, _MOST_SURFELS = 0.999, 0.5, 0.3, 25.0, 200_000


def near(
    points: NDArray[np.float32], T_map_points: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Return the points of a scan within ``CLOUD_REACH_M``: positions (m, 3), metres, map frame, and intensities (m,).

    Args:
        points: x, y, z (metres, frame of the LiDAR or its level frame) and intensity (n, 4).
        T_map_points: pose of the frame of the points (4, 4).
    """
    reached = points.compress(lengths(points[:, :3]) < CLOUD_REACH_M, axis=0)
    return transform_points(T_map_points, reached[:, :3].astype(np.float64)), reached[:, 3]


class Regions(Protocol):
    """Chooses the regions of the lookup grid that a tile has (``tile_area.TileArea``)."""

    def has_cells(self, centres: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return whether the tile has the cells of each region (n,).

        Args:
            centres: centres of regions, metres, map frame (n, 3).
        """


def prepared(cloud: VoxelMap, regions: Regions | None = None) -> SurfelMap | None:
    """Prepare the cloud for registration; None if there is no surfel.

    Args:
        cloud: the voxel map.
        regions: chooses the regions of a tile, whose grid then lies on the lattice of all tiles. None for a map of one bundle.
    """
    surfels, brightness = cloud.surfels()
    if not len(surfels):
        return None
    packed = SurfelMap.packed(surfels, brightness, None if regions is None else -cloud.origin)
    del surfels, brightness  # a large map has no room for them beside the grid
    has_cells = None if regions is None else lambda centres: regions.has_cells(centres + cloud.origin)
    found = SurfelMap.of_packed(cloud.origin, *packed, has_cells)
    trim()  # the grid is made of many small blocks at first
    return found


def with_cloud(content: BundleContent, cloud: VoxelMap, regions: Regions | None = None) -> BundleContent:
    """Return the map with a cloud, the voxel sums for merging, and the preview image. ``cloud`` must not change until it is written.

    Args:
        content: the map. Its own cloud, sums and preview are replaced.
        cloud: the voxel map of the cloud.
        regions: as of ``prepared``.
    """
    surfel_map = prepared(cloud, regions)
    height_m = None if surfel_map is None else surveyed_height_m(surfel_map, content)
    others = {name: value for name, value in content.parameters.items() if name != SURVEYED_HEIGHT}
    return replace(
        content,
        parameters=others if height_m is None else others | {SURVEYED_HEIGHT: height_m},
        cloud=surfel_map,
        statistics=None if surfel_map is None else cloud.columns(),
        preview_webp=preview_webp(surfel_map, content.T_map_place[:, :3, 3]),
    )


def surveyed_height_m(cloud: SurfelMap, content: BundleContent) -> float | None:
    """Return the height above the ground up to which the survey saw surfaces, metres; None without surfels beside the places.

    A LiDAR with few beams above the horizon sees only the lower part of a street. A camera also sees what lies higher. Such points
    have no surfel near them at any pose, so registration omits them (decision 0177).

    Args:
        cloud: cloud of the map.
        content: the map. Its places give the ground.
    """
    xyz = cloud.unpacked(slice(None, None, 1 + len(cloud.surfels) // _MOST_SURFELS))["xyz"] + cloud.origin_m
    places_m = content.T_map_place[:, :3, 3]
    if not len(places_m):
        return None
    distance_m, nearest = cKDTree(places_m[:, :2]).query(xyz[:, :2])
    above_m = xyz[:, 2] - (places_m[nearest, 2] - content.parameters["lidar_height_m"])
    counted = above_m[(distance_m < _BESIDE_M) & (above_m > _GROUND_M)]
    return float(np.quantile(counted, _SURVEYED_SHARE)) + _RIM_M if len(counted) else None
