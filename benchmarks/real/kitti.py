"""Measure KITTI recordings: import them, build maps with the stock encoder, and send queries over HTTP."""

import shutil
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.real.served import away_m, served
from benchmarks.real.stereo_frames import LIDAR_HEIGHT_M, QUERIES, stereo_frames
from benchmarks.real.streets import status_rows
from benchmarks.report import Report
from model_training.datasets.dataset import Dataset, read_tum
from model_training.importing.kinds import OpenSettings, open_recording
from model_training.importing.pose_file import read_pose_file
from model_training.importing.take import TakeSettings, take
from model_training.importing.trajectory import Trajectory
from model_training.mapping.build import build_map
from model_training.mapping.settings import BuildSettings
from model_training.odometry.find import find_trajectory
from model_training.stock import ENCODER
from service.geometry.rigid import transform_from

DRIVE = Path("2011_09_26") / "2011_09_26_drive_sync"
SETTINGS = OpenSettings(depth="lidar")
NOT_HELD_OUT = "not held out: the traffic vote was chosen on these frames"
NO_DATA = "no recordings at {name}"


def drive_rows(report: Report, data: Path, work: Path) -> None:
    """Add the rows ``kitti_drive``: every second scan makes the map, and the frames between are queries; then with both swapped.

    Args:
        report: receives the rows.
        data: folder of the recordings.
        work: folder of datasets and maps.
    """
    source = data / "kitti_drive" / DRIVE
    if not source.exists():
        for row, unit in (("within_1_m", "share"), ("median_m", "m"), ("odometry_vs_reference_m", "m")):
            report.row(f"kitti_drive.{row}", None, unit, bar=0.0, why=NO_DATA.format(name=data.name))
        return
    reference = source / "reference_poses.txt"
    stamps, T_reference = read_tum(reference)
    found = find_trajectory(open_recording("kitti-raw", source, SETTINGS), close_loops=False).trajectory
    odometry = _in_frame_of(found, stamps, T_reference)
    drift = away_m(odometry.between(stamps), T_reference)
    report.row("kitti_drive.odometry_vs_reference_m", float(drift.mean()), "m", bar=0.05, better="lower", n=len(drift))
    later = away_m(_in_frame_of(found, stamps[1:], T_reference[1:]).between(stamps[1:]), T_reference[1:])
    report.row("kitti_drive.odometry_vs_reference_without_first_m", float(later.mean()), "m", n=len(later))
    away = {"given": read_pose_file(reference), "odometry": odometry}
    errors = {
        name: _both_halves(source, poses, work / f"kitti_drive_{name}", reference) for name, poses in away.items()
    }
    for name, error_m in errors.items():
        report.share(f"kitti_drive.{name}_poses.within_1_m", error_m <= 1.0)
        report.row(f"kitti_drive.{name}_poses.median_m", float(np.median(error_m)), "m", n=len(error_m))
    both = np.concatenate(list(errors.values()))
    report.share("kitti_drive.within_1_m", both <= 1.0, bar=1.0)
    report.row(
        "kitti_drive.median_m", float(np.median(both)), "m", bar=0.12, better="lower", n=len(both), why=NOT_HELD_OUT
    )


def stereo_rows(report: Report, data: Path, work: Path) -> None:
    """Add the rows ``real.kitti_stereo``: one map of all scans, and stereo frames with SGBM depth as queries.

    Args:
        report: receives the rows.
        data: folder of the recordings.
        work: folder of datasets and maps.
    """
    found = stereo_frames(data, work)
    if found is None:
        report.row("real.kitti_stereo.answered_within_1_m", None, "share", bar=1.0, why=NO_DATA.format(name=data.name))
        return
    dataset, bundle = found
    truth = np.array([frame.T_map_camera for frame in dataset.queries(QUERIES)])
    answered = served(bundle, dataset, QUERIES)
    away = away_m(answered.T_map_camera, truth)
    status_rows(report, "real.kitti_stereo", away, answered.localized, bars=(1.0, None, None))


def _both_halves(source: Path, poses: Trajectory, work: Path, reference: Path) -> NDArray[np.float64]:
    """Return the distances (n,) of the answers from the reference, metres. Each frame is a query to the map without its scan."""
    away = []
    for first in (0, 1):
        folder, bundle = work.with_name(f"{work.name}_{first}"), work.with_name(f"{work.name}_{first}_map")
        _fresh(folder, bundle)
        recording = open_recording("kitti-raw", source, SETTINGS)
        take(recording, poses, folder, TakeSettings(depth="lidar", hold_out=2, hold_out_first=first))
        dataset = Dataset(folder)
        settings = BuildSettings(name="kitti-drive", spacing_m=0.0, expected_lidar_height_m=LIDAR_HEIGHT_M)
        build_map(dataset, ENCODER, bundle, settings)
        frames = list(dataset.queries("recorded"))
        camera = np.array(frames[0].camera.T_vehicle_sensor)
        stamps = np.array([frame.stamp_s for frame in frames], np.float64)
        answered = served(bundle, dataset, "recorded").T_map_camera
        away.append(away_m(answered, read_pose_file(reference).between(stamps) @ camera))
    return np.concatenate(away)


def _in_frame_of(trajectory: Trajectory, stamps_s: NDArray[np.float64], T_reference: NDArray[np.float64]) -> Trajectory:
    """Return the trajectory after a rigid alignment to the reference, because the frames of odometry and reference differ.

    Rotation: the mean rotation between the poses. On a straight drive, positions alone do not determine the roll.
    """
    T = trajectory.between(stamps_s)
    turns = T_reference[:, :3, :3] @ T[:, :3, :3].transpose(0, 2, 1)
    u, _, vt = np.linalg.svd(turns.mean(axis=0))
    R = u @ vt
    moved = transform_from(R, T_reference[:, :3, 3].mean(axis=0) - R @ T[:, :3, 3].mean(axis=0))
    return Trajectory(trajectory.stamps_s, moved @ trajectory.T_map_vehicle, trajectory.name)


def _fresh(*folders: Path) -> None:
    for folder in folders:
        shutil.rmtree(folder, ignore_errors=True)
        folder.parent.mkdir(parents=True, exist_ok=True)
