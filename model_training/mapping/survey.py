"""A survey's scans as a map takes them: those that stand far enough apart, levelled, looked at all round."""

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

SEEN_SHARE = 0.02  # a row of the grid is the survey's if at least this share of its cells is measured


@dataclass(frozen=True, slots=True)
class LevelledScan:
    """One kept scan: its number, level points with intensity (n, 4), level, and the principal heading that its fan starts at (rad)."""

    number: int
    points: NDArray[np.float32]
    level: Level
    start_rad: float

    def T_map_level(self, T_map_lidar: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pose of the levelled LiDAR, from that of the LiDAR."""
        return T_map_lidar @ transform_from(self.level.R_level_sensor.T, np.zeros(3))


def fan(headings: int) -> NDArray[np.float64]:
    """Turns of a place's views against its principal heading, radians."""
    return 2 * np.pi * np.arange(headings) / headings


def fan_views(scan: LevelledScan, turns: NDArray[np.float64], grid: ViewGrid) -> Iterator[LidarView]:
    """What a scan shows in each direction of the fan."""
    panorama = panorama_from_points(scan.points, grid)
    for turn in turns:
        yield view_from_panorama(panorama, scan.start_rad + float(turn), grid)


def view_ranges(
    dataset: Dataset, settings: BuildSettings, grid: ViewGrid, rows_seen: NDArray[np.bool_]
) -> Iterator[NDArray[np.float32]]:
    """Range views (headings, rows, columns) of every place of the map that these settings build, in its order."""
    kept = thinned(dataset.survey_poses(), settings.spacing_m)
    turns = fan(settings.headings)
    for scan in levelled_scans(dataset, kept, settings):
        yield np.stack([view[0] for view in fan_views(scan, turns, grid)]) * rows_seen[:, None]


def kept_scans(dataset: Dataset, settings: BuildSettings) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """T_map_lidar of every scan (n, 4, 4), and the numbers of those that become places.

    Raises:
        DatasetError: the survey is empty.
    """
    poses = dataset.survey_poses()
    if not len(poses):
        raise DatasetError(
            f"{dataset.folder}/survey/poses.txt is empty: there is nothing to build a map of", field="survey"
        )
    return poses, thinned(poses, settings.spacing_m)


def require_poses_within(cloud: VoxelMap, poses: NDArray[np.float64], dataset: Dataset) -> None:
    """Refuse a survey that leaves the reach of a cloud; said before the work, not in its middle.

    Raises:
        DatasetError: names the file, the line's scan and how far off it is.
    """
    cloud.require_within(poses[:, :3, 3], lambda number: f"{dataset.folder}/survey/poses.txt: scan {number}")


def thinned(poses: NDArray[np.float64], spacing_m: float) -> NDArray[np.int64]:
    """Numbers of the poses that stand ``spacing_m`` of travel, less a tenth for noisy poses, after the last one kept."""
    travelled = travelled_m(poses)
    kept, last = [0], 0.0
    for k in range(1, len(poses)):
        if travelled[k] - last >= 0.9 * spacing_m:
            kept.append(k)
            last = travelled[k]
    return np.array(kept)


def travelled_m(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Way from the first pose to each of (n, 4, 4), metres."""
    return np.asarray(np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1))])


def levelled_scans(dataset: Dataset, numbers: NDArray[np.int64], settings: BuildSettings) -> Iterator[LevelledScan]:
    """Scans one at a time, levelled by PCA, each with its principal heading."""
    for number in numbers:
        points = clear_scan(dataset, int(number), settings)
        level = level_scan(points[:, :3], expected_height_m=settings.expected_lidar_height_m)
        levelled = np.c_[points[:, :3] @ level.R_level_sensor.T.astype(np.float32), points[:, 3]]
        yield LevelledScan(int(number), levelled, level, principal_heading(levelled[:, :3], height_m=level.height_m))


def clear_scan(dataset: Dataset, number: int, settings: BuildSettings) -> NDArray[np.float32]:
    """Scan ``number`` (n, 4), LiDAR frame, without rain and snow where the settings say so."""
    points = dataset.scan(number)
    return points[remove_weather_noise(points[:, :3])] if settings.remove_weather else points


def rows_seen_by(
    dataset: Dataset, kept: NDArray[np.int64], grid: ViewGrid, settings: BuildSettings, *, sample: int = 100
) -> NDArray[np.bool_]:
    """Rows that the survey's sensor covers, from a sample of its scans; what it never sees is cut from queries too.

    Raises:
        DatasetError: it sees none.
    """
    chosen = kept[:: max(1, len(kept) // sample)]
    measured = np.zeros(grid.rows)
    for scan in levelled_scans(dataset, chosen, settings):
        measured += (panorama_from_points(scan.points, grid)[0] > 0).mean(axis=1)
    seen: NDArray[np.bool_] = measured / len(chosen) > SEEN_SHARE
    if not seen.any():
        raise DatasetError(
            f"{dataset.folder}: the scans have no points between {grid.elevation_bottom_deg:g} and {grid.elevation_top_deg:g} degrees "
            f"of elevation within {grid.max_range_m:g} m: check units and axes (metres, z up)", field="survey",
        )  # fmt: skip
    return seen
