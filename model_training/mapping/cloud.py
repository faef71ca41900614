"""The cloud of a map, from the points of its scans to what a bundle holds."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from model_training.mapping.preview import preview_webp
from model_training.mapping.voxel_map import Surfels, VoxelMap
from service.geometry.rigid import transform_points
from service.maps.content import BundleContent
from service.registration.surfel_map import SurfelMap

CLOUD_REACH_M = 40.0


def near(
    points: NDArray[np.float32], T_map_level: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """What of a levelled scan (n, 4) goes into the cloud: positions, map frame, and intensities."""
    reached = points[np.linalg.norm(points[:, :3], axis=1) < CLOUD_REACH_M]
    return transform_points(T_map_level, reached[:, :3].astype(np.float64)), reached[:, 3]


def prepared(cloud: VoxelMap, surfels: Surfels | None = None) -> SurfelMap | None:
    """The cloud as a service reads it; None where nothing makes a surface."""
    found = cloud.surfels() if surfels is None else surfels
    return SurfelMap.prepare(cloud.origin, *cloud.tiles(found)) if len(found.positions) else None


def with_cloud(content: BundleContent, cloud: VoxelMap) -> BundleContent:
    """The map with this cloud, what it can be merged by, and the picture from above."""
    surfels = cloud.surfels()
    preview = preview_webp(surfels.positions, surfels.normals, content.T_map_place[:, :3, 3])
    return replace(
        content, cloud=prepared(cloud, surfels), statistics=cloud.statistics() if len(surfels.positions) else None,
        preview_webp=preview,
    )  # fmt: skip
