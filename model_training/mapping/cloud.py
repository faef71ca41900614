"""Compute the cloud of a map: from the points of the scans to the content of a bundle."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from model_training.mapping.preview import preview_webp
from model_training.mapping.voxel_map import VoxelMap
from service.geometry.lengths import lengths
from service.geometry.rigid import transform_points
from service.heap import trim
from service.maps.content import BundleContent
from service.registration.surfel_map import SurfelMap

#: Largest range of a point in the cloud, metres.
CLOUD_REACH_M = 40.0


def near(
    points: NDArray[np.float32], T_map_points: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Return the points of a scan within ``CLOUD_REACH_M``: positions (m, 3), metres, map frame, and intensities (m,).

    Args:
        points: x, y, z (metres, frame of the LiDAR or its level frame) and intensity (n, 4).
        T_map_points: pose of the frame of the points (4, 4).
    """
    reached = points[lengths(points[:, :3]) < CLOUD_REACH_M]
    return transform_points(T_map_points, reached[:, :3].astype(np.float64)), reached[:, 3]


def prepared(cloud: VoxelMap) -> SurfelMap | None:
    """Prepare the cloud for registration; None if there is no surfel.

    Args:
        cloud: the voxel map.
    """
    surfels, brightness = cloud.surfels()
    found = SurfelMap.prepare(cloud.origin, surfels, brightness) if len(surfels) else None
    trim()  # the grid is made of many small blocks at first
    return found


def with_cloud(content: BundleContent, cloud: VoxelMap) -> BundleContent:
    """Return the map with a cloud, the voxel sums for merging, and the preview image. ``cloud`` must not change until it is written.

    Args:
        content: the map. Its own cloud, sums and preview are replaced.
        cloud: the voxel map of the cloud.
    """
    surfel_map = prepared(cloud)
    return replace(
        content,
        cloud=surfel_map,
        statistics=None if surfel_map is None else cloud.columns(),
        preview_webp=preview_webp(surfel_map, content.T_map_place[:, :3, 3]),
    )
