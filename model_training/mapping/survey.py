"""Prepare the scans of a survey for a map: select them by distance, level them and render their views."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model_training.datasets.dataset import Dataset
from model_training.mapping.settings import BuildSettings
from model_training.mapping.voxel_map import VoxelMap
from service.errors import DatasetError
from service.geometry.rigid import transform_from
from service.imaging.pca import Level, level_scan, principal_heading
from service.imaging.view_grid import LidarView, ViewGrid, panorama_from_points, view_from_panorama
from service.imaging.weather import remove_weather_noise

#: The survey covers a row of the view grid if more than this share of the row's cells is measured.
SEEN_SHARE = 0.02


@dataclass(frozen=True, slots=True)
class LevelledScan:
    """A levelled scan.

    Attributes:
        number: index of the scan in the survey.
        points: x, y, z (metres, level frame of the LiDAR) and intensity (n, 4).
        level: level of the scan.
        start_rad: principal heading, at which the fan of views starts, radians, level frame.
    """

    number: int
    points: NDArray[np.float32]
    level: Level
    start_rad: float

    def T_map_level(self, T_map_lidar: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the pose of the levelled LiDAR (4, 4).

        Args:
            T_map_lidar: pose of the LiDAR (4, 4).
        """
        return T_map_lidar @ transform_from(self.level.R_level_sensor.T, np.zeros(3))


def fan(headings: int) -> NDArray[np.float64]:
    """Return the heading of each view relative to the principal heading of its place, radians (headings,).

    Args:
        headings: number of views.
    """
    return 2 * np.pi * np.arange(headings) / headings


def fan_views(points: NDArray[np.float32], headings_rad: NDArray[np.float64], grid: ViewGrid) -> Iterator[LidarView]:
    """Yield the view of points in each direction of a fan.

    Args:
        points: x, y, z (metres, level frame) and intensity (n, 4).
        headings_rad: heading of each view, radians, level frame (headings,).
        grid: the view grid.
    """
    panorama = panorama_from_points(points, grid)
    for heading_rad in headings_rad:
        yield view_from_panorama(panorama, float(heading_rad), grid)


def view_ranges(
    dataset: Dataset, settings: BuildSettings, grid: ViewGrid, rows_seen: NDArray[np.bool_]
) -> Iterator[NDArray[np.float32]]:
    """Yield the range views (headings, rows, columns), metres, of every place at a scan, in the order of the places.

    A map has the places between scans after them.

    Args:
        dataset: the dataset with the survey.
        settings: settings of the map.
        grid: the view grid.
        rows_seen: True for the rows of the grid that the map uses (rows,). The other rows become 0.
    """
    kept = thinned(dataset.survey_poses(), settings.spacing_m)
    turns = fan(settings.headings)
    for scan in levelled_scans(dataset, kept, settings):
        yield np.stack([view[0] for view in fan_views(scan.points, scan.start_rad + turns, grid)]) * rows_seen[:, None]


def kept_scans(dataset: Dataset, settings: BuildSettings) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return T_map_lidar of every scan (n, 4, 4) and the indices of the scans that become places (P,).

    Args:
        dataset: the dataset with the survey.
        settings: settings of the map.

    Raises:
        DatasetError: the survey is empty.
    """
    poses = dataset.survey_poses()
    if not len(poses):
        raise DatasetError(
            f"{dataset.place}/survey/poses.txt is empty, so no map can be built; import the survey again",
            field="survey",
        )
    return poses, thinned(poses, settings.spacing_m)


def require_poses_within(cloud: VoxelMap, poses: NDArray[np.float64], dataset: Dataset) -> None:
    """Refuse a survey that exceeds the reach of a cloud, before the build starts.

    Args:
        cloud: the voxel map that the scans would go into.
        poses: T_map_lidar of every scan (n, 4, 4).
        dataset: the dataset, for the error message.

    Raises:
        DatasetError: a pose is too far away. The message names the file, the scan and its distance.
    """
    cloud.require_within(poses[:, :3, 3], lambda number: f"{dataset.place}/survey/poses.txt: scan {number}")


def thinned(poses: NDArray[np.float64], spacing_m: float) -> NDArray[np.int64]:
    """Return the indices of poses that keep the spacing to the last kept one (P,), along the travelled path.

    Poses are noisy, so 0.9 times the spacing is enough.

    Args:
        poses: T_map_lidar in the order of the traversal (n, 4, 4).
        spacing_m: travelled distance between kept poses, metres.
    """
    travelled = travelled_m(poses)
    kept, last = [0], 0.0
    for k in range(1, len(poses)):
        if travelled[k] - last >= 0.9 * spacing_m:
            kept.append(k)
            last = travelled[k]
    return np.array(kept)


def travelled_m(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the travelled distance from the first pose to each pose, metres (n,).

    Args:
        poses: poses in the order of the traversal (n, 4, 4).
    """
    return np.asarray(np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1))])


def levelled_scans(dataset: Dataset, numbers: NDArray[np.int64], settings: BuildSettings) -> Iterator[LevelledScan]:
    """Yield scans one at a time, levelled by PCA, each with its principal heading.

    Args:
        dataset: the dataset with the survey.
        numbers: indices of the scans (n,).
        settings: settings of the map: the expected LiDAR height, and whether weather is removed.
    """
    for number in numbers:
        yield levelled(clear_scan(dataset, int(number), settings), int(number), settings)


def levelled(points: NDArray[np.float32], number: int, settings: BuildSettings) -> LevelledScan:
    """Level a scan by PCA, and find its principal heading.

    Args:
        points: x, y, z (metres, LiDAR frame) and intensity (n, 4).
        number: index of the scan.
        settings: settings of the map: the expected LiDAR height.
    """
    level = level_scan(points[:, :3], expected_height_m=settings.expected_lidar_height_m)
    turned = np.empty((len(points), 4), np.float32)
    turned[:, :3], turned[:, 3] = points[:, :3] @ level.R_level_sensor.T.astype(np.float32), points[:, 3]
    return LevelledScan(number, turned, level, principal_heading(turned[:, :3], height_m=level.height_m))


def clear_scan(dataset: Dataset, number: int, settings: BuildSettings) -> NDArray[np.float32]:
    """Return a scan: x, y, z (metres, LiDAR frame) and intensity (n, 4), without rain and snow if the settings say so.

    Args:
        dataset: the dataset with the survey.
        number: index of the scan.
        settings: settings of the map: whether weather is removed.
    """
    points = dataset.scan(number)
    return points[remove_weather_noise(points[:, :3])] if settings.remove_weather else points


def sampled_survey(
    dataset: Dataset, kept: NDArray[np.int64], grid: ViewGrid, settings: BuildSettings, *, sample: int = 100
) -> tuple[NDArray[np.bool_], float]:
    """Return what an evenly spread sample of the scans shows about the survey's LiDAR.

    Args:
        dataset: the dataset with the survey.
        kept: indices of the scans that become places (P,).
        grid: the view grid.
        settings: settings of the map.
        sample: approximate number of scans in the sample.

    Returns:
        Which rows of the view grid the LiDAR covers (rows,), and the median of its height above the ground, metres. The other rows are
        also removed from query views.

    Raises:
        DatasetError: the LiDAR covers no row.
    """
    chosen = kept[:: max(1, len(kept) // sample)]
    measured, heights_m = np.zeros(grid.rows), []
    for scan in levelled_scans(dataset, chosen, settings):
        measured += (panorama_from_points(scan.points, grid)[0] > 0).mean(axis=1)
        heights_m.append(scan.level.height_m)
    seen: NDArray[np.bool_] = measured / len(chosen) > SEEN_SHARE
    if not seen.any():
        raise DatasetError(
            f"{dataset.place}: the scans have no points between {grid.elevation_bottom_deg:g} and {grid.elevation_top_deg:g} degrees "
            f"of elevation within {grid.max_range_m:g} m: check units and axes (metres, z up)",
            field="survey",
        )
    return seen, float(np.median(heights_m))
