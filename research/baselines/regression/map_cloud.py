"""The map as points: the survey's scans in one thinned cloud for registration."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model_training.datasets.dataset import Dataset
from model_training.mapping.voxel_map import VoxelMap
from research.baselines.learning import Report
from service.errors import ExtraMissingError, how_to_install

VOXEL_M = 0.3
#: Distance along the traversal between used scans, metres. Scans in between see the same walls.
EVERY_M = 1.0
#: Largest range of a scan's points, metres. Beyond it, the rings of a scan are metres apart.
REACH_M = 60.0
TILE_M = 10.0
#: Number of neighbours of a normal.
NEIGHBOURS = 12

PointsF64 = NDArray[np.float64]  # (n, 3)


@dataclass(frozen=True)
class MapCloud:
    """Map cloud.

    Attributes:
        points_map: means of the voxels (n, 3), metres, map frame.
    """

    points_map: PointsF64

    def around(self, xyz: NDArray[np.float64], reach_m: float, *, every: int = 1) -> PointsF64:
        """Return points (n, 3) in a ball around a position, each tile thinned evenly.

        Args:
            xyz: position (3,), metres, map frame.
            reach_m: radius, metres.
            every: take each n-th point of each tile.
        """
        low = np.floor((xyz[:2] - reach_m) / TILE_M).astype(int)
        high = np.floor((xyz[:2] + reach_m) / TILE_M).astype(int)
        tiles = [(x, y) for x in range(low[0], high[0] + 1) for y in range(low[1], high[1] + 1)]
        near = np.concatenate(
            [np.zeros((0, 3)), *(self._tiles[each][::every] for each in tiles if each in self._tiles)]
        )
        inside: PointsF64 = near[((near - xyz) ** 2).sum(axis=1) < reach_m**2]
        return inside

    @cached_property
    def _tiles(self) -> dict[tuple[int, int], PointsF64]:
        """Points of each square of ground, in random order."""
        shuffled = np.random.default_rng(0).permutation(self.points_map)
        cell = np.floor(shuffled[:, :2] / TILE_M).astype(np.int64)
        order = np.lexsort((cell[:, 1], cell[:, 0]))
        cell, ordered = cell[order], shuffled[order]
        starts = np.flatnonzero((np.diff(cell, axis=0) != 0).any(axis=1)) + 1
        return {
            (int(xy[0, 0]), int(xy[0, 1])): points
            for xy, points in zip(np.split(cell, starts), np.split(ordered, starts), strict=True)
            if len(points)
        }

    @cached_property
    def target(self) -> tuple[Any, Any]:
        """The cloud with its normals, and its k-d tree, as targets of small_gicp.

        Raises:
            ExtraMissingError: small_gicp is not installed.
        """
        package = small_gicp_package()
        cloud = package.PointCloud(self.points_map)
        tree = package.KdTree(cloud, num_threads=1)
        package.estimate_normals(cloud, tree, num_neighbors=NEIGHBOURS, num_threads=1)
        return cloud, tree


def small_gicp_package() -> Any:
    """Import small_gicp.

    Raises:
        ExtraMissingError: it is not installed.
    """
    try:
        import small_gicp
    except ModuleNotFoundError as error:
        raise ExtraMissingError(f"ICP needs small_gicp: {how_to_install('mapping')}", field="small_gicp") from error
    return small_gicp


def make_map_cloud(dataset: Dataset, cache: Path, *, report: Report = lambda *_: None) -> MapCloud:
    """Join the survey's scans by their recorded poses, or load an earlier result.

    Args:
        dataset: dataset of the survey.
        cache: file (.npy) of the result.
        report: receives a label, the number of scans done and their total.
    """
    if not cache.exists():
        T_map_lidar = dataset.survey_poses()
        chosen = _spread(T_map_lidar[:, :3, 3])
        voxels = VoxelMap(VOXEL_M, T_map_lidar[:, :3, 3].mean(axis=0))
        for done, number in enumerate(chosen, 1):
            points = dataset.scan(number)[:, :3].astype(np.float64)
            near = points[(points**2).sum(axis=1) < REACH_M**2]
            voxels.add(near @ T_map_lidar[number, :3, :3].T + T_map_lidar[number, :3, 3])
            report("map cloud", done, len(chosen))
        cache.parent.mkdir(parents=True, exist_ok=True)
        part = cache.with_name(cache.name + ".part")
        with part.open("wb") as file:
            np.save(file, voxels.means())
        part.rename(cache)
    return MapCloud(np.load(cache, allow_pickle=False))


def _spread(xyz: PointsF64) -> list[int]:
    """Choose rows of a traversal, each at least ``EVERY_M`` from the previous one."""
    chosen: list[int] = []
    for number, here in enumerate(xyz):
        if not chosen or np.linalg.norm(here - xyz[chosen[-1]]) >= EVERY_M:
            chosen.append(number)
    return chosen
