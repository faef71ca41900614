"""Keyframes of a traversal: a scan every two metres, thinned, with descriptors in all directions, kept on disk."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64
from numpy.typing import NDArray

from model_training.mapping.survey import fan
from model_training.odometry.scan_to_map import PosedScan
from service.geometry.rigid import Transform
from service.imaging.pca import USUAL_LIDAR_HEIGHT_M, Level, level_scan, principal_heading
from service.imaging.view_grid import ViewGrid, fan_planes, panorama_from_points
from service.retrieval.encoder import Encoder

#: Least distance travelled between keyframes, metres.
SPACING_M = 2.0
#: Views per keyframe, one every 15 degrees.
HEADINGS = 24
#: Edge of the cells that keep one point each, and greatest range of a kept point, metres.
CELL_M, REACH_M = 0.25, 40.0


@dataclass(frozen=True)
class Keyframe:
    """One kept scan.

    Attributes:
        index: position among the keyframes.
        stamp_s: time of the scan, seconds.
        T_first_lidar: pose from odometry, in the LiDAR frame of the first scan.
        travelled_m: distance travelled since the first scan, metres.
        level: levelling of the scan.
        start_rad: heading of the first view, in the level frame, radians: the principal heading of the scan.
        descriptors: one per view, counter-clockwise from the first view.
    """

    index: int
    stamp_s: float
    T_first_lidar: Transform
    travelled_m: float
    level: Level
    start_rad: float
    descriptors: Float32[NDArray[np.float32], "H D"]


@dataclass(frozen=True)
class OdometryTrajectory:
    """A traversal from odometry.

    Attributes:
        stamps_s: time of every scan, seconds.
        T_first_lidar: pose of every scan, in the LiDAR frame of the first scan.
        keyframes: in order of time.
        folder: holds the points of the keyframes.
    """

    stamps_s: Float64[NDArray[np.float64], " N"]
    T_first_lidar: Float64[NDArray[np.float64], "N 4 4"]
    keyframes: tuple[Keyframe, ...]
    folder: Path

    def points(self, index: int) -> Float32[NDArray[np.float32], "M 3"]:
        """Load the thinned points of a keyframe, LiDAR frame, metres.

        Args:
            index: number of the keyframe.
        """
        loaded: NDArray[np.float32] = np.load(self.folder / f"{index:06d}.npy", allow_pickle=False)
        return loaded


def drive_of(
    scans: Iterable[PosedScan],
    encoder: Encoder | None,
    folder: Path,
    *,
    expected_height_m: float = USUAL_LIDAR_HEIGHT_M,
    report: Callable[[int], None] = lambda _: None,
) -> OdometryTrajectory:
    """Collect poses and keyframes of a traversal.

    Args:
        scans: with poses.
        encoder: describes the keyframes; None keeps poses and no keyframes.
        folder: for the points of the keyframes. Only descriptors stay in memory.
        expected_height_m: approximate height of the LiDAR above the ground, metres.
        report: called with the number of scans done.
    """
    stamps: list[float] = []
    poses: list[Transform] = []
    keyframes: list[Keyframe] = []
    travelled_m = 0.0
    for done, scan in enumerate(scans, 1):
        if poses:
            travelled_m += float(np.linalg.norm(scan.T_first_lidar[:3, 3] - poses[-1][:3, 3]))
        stamps.append(scan.stamp_s)
        poses.append(scan.T_first_lidar)
        if encoder is not None and (not keyframes or travelled_m - keyframes[-1].travelled_m >= SPACING_M):
            np.save(folder / f"{len(keyframes):06d}.npy", _thinned(scan.points[:, :3]))
            keyframes.append(_keyframe(scan, len(keyframes), travelled_m, encoder, expected_height_m))
        report(done)
    return OdometryTrajectory(np.array(stamps), np.array(poses).reshape(-1, 4, 4), tuple(keyframes), folder)


def _keyframe(scan: PosedScan, index: int, travelled_m: float, encoder: Encoder, expected_height_m: float) -> Keyframe:
    level = level_scan(scan.points[:, :3], expected_height_m=expected_height_m)
    levelled = np.c_[scan.points[:, :3] @ level.R_level_sensor.T.astype(np.float32), scan.points[:, 3]]
    start_rad = principal_heading(levelled[:, :3], height_m=level.height_m)
    grid = ViewGrid(rows=encoder.rows, columns=encoder.columns)
    panorama = panorama_from_points(levelled, grid)
    every_row = np.ones(grid.rows, np.bool_)  # one LiDAR recorded both sides of a comparison
    planes = fan_planes(
        panorama, start_rad + fan(HEADINGS), sensor_height_m=level.height_m, rows_seen=every_row, grid=grid
    )
    descriptors = encoder.encode(planes, "survey")
    return Keyframe(index, scan.stamp_s, scan.T_first_lidar, travelled_m, level, start_rad, descriptors)


def _thinned(points: NDArray[np.float32]) -> NDArray[np.float32]:
    """Keep one point per cell, the first one, within ``REACH_M``."""
    near = points[np.linalg.norm(points, axis=1) < REACH_M]
    cell = np.floor(near / CELL_M).astype(np.int64)
    key = (cell[:, 0] * 4096 + cell[:, 1]) * 4096 + cell[:, 2]
    return np.ascontiguousarray(near[np.unique(key, return_index=True)[1]])
