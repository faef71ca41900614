"""Keyframes of a drive: every other metre a scan, thinned, described from all sides, and kept on disk."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64
from numpy.typing import NDArray

from model_training.mapping.build import fan
from model_training.odometry.scan_to_map import PosedScan
from service.geometry.rigid import Transform
from service.imaging.pca import Level, level_scan, principal_heading
from service.imaging.view_grid import ViewGrid, panorama_from_points, survey_planes, view_from_panorama
from service.localization.encoder import Encoder

SPACING_M = 2.0
HEADINGS = 24
#: Edge of the cells that keep one point each, and how far points are kept.
CELL_M, REACH_M = 0.25, 40.0


@dataclass(frozen=True)
class Keyframe:
    """One kept scan.

    Attributes:
        index: among the keyframes.
        stamp_s: of the scan.
        T_first_lidar: by odometry.
        travelled_m: since the first scan.
        level: of the scan.
        start_rad: principal heading in the level frame, where its fan of views starts.
        descriptors: of the views, counter-clockwise from there.
    """

    index: int
    stamp_s: float
    T_first_lidar: Transform
    travelled_m: float
    level: Level
    start_rad: float
    descriptors: Float32[NDArray[np.float32], "H D"]


@dataclass(frozen=True)
class Drive:
    """A drive by odometry: times and poses of all scans, and its keyframes with their points.

    Attributes:
        stamps_s: of every scan.
        T_first_lidar: of every scan.
        keyframes: in order of time.
        folder: where the keyframes' points lie.
    """

    stamps_s: Float64[NDArray[np.float64], " N"]
    T_first_lidar: Float64[NDArray[np.float64], "N 4 4"]
    keyframes: tuple[Keyframe, ...]
    folder: Path

    def points(self, index: int) -> Float32[NDArray[np.float32], "M 3"]:
        """Thinned points of a keyframe, metres, LiDAR frame."""
        loaded: NDArray[np.float32] = np.load(self.folder / f"{index:06d}.npy", allow_pickle=False)
        return loaded


def drive_of(
    scans: Iterable[PosedScan], encoder: Encoder | None, folder: Path, *, expected_height_m: float = 1.8,
    report: Callable[[int], None] = lambda _: None,
) -> Drive:  # fmt: skip
    """Follow a drive to its end.

    Args:
        scans: with poses.
        encoder: describes the keyframes; None keeps poses alone.
        folder: for the keyframes' points; memory holds their descriptors only.
        expected_height_m: of the LiDAR above the ground, roughly.
        report: told the scans done.
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
    return Drive(np.array(stamps), np.array(poses).reshape(-1, 4, 4), tuple(keyframes), folder)


def _keyframe(scan: PosedScan, index: int, travelled_m: float, encoder: Encoder, expected_height_m: float) -> Keyframe:
    level = level_scan(scan.points[:, :3], expected_height_m=expected_height_m)
    levelled = np.c_[scan.points[:, :3] @ level.R_level_sensor.T.astype(np.float32), scan.points[:, 3]]
    start_rad = principal_heading(levelled[:, :3], height_m=level.height_m)
    grid = ViewGrid(rows=encoder.rows, columns=encoder.columns)
    panorama = panorama_from_points(levelled, grid)
    every_row = np.ones(grid.rows, np.bool_)  # both sides of a comparison are of one LiDAR
    planes = np.stack([
        survey_planes(view_from_panorama(panorama, start_rad + turn, grid), sensor_height_m=level.height_m, rows_seen=every_row, grid=grid)
        for turn in fan(HEADINGS)
    ])  # fmt: skip
    descriptors = encoder.encode(planes, "survey")
    return Keyframe(index, scan.stamp_s, scan.T_first_lidar, travelled_m, level, start_rad, descriptors)


def _thinned(points: NDArray[np.float32]) -> NDArray[np.float32]:
    """One point a cell, the first met."""
    near = points[np.linalg.norm(points, axis=1) < REACH_M]
    cell = np.floor(near / CELL_M).astype(np.int64)
    key = (cell[:, 0] * 4096 + cell[:, 1]) * 4096 + cell[:, 2]
    return np.ascontiguousarray(near[np.unique(key, return_index=True)[1]])
