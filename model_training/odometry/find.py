"""Find the poses of a recording that has none: odometry, then loop closure."""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from model_training.importing.recording import Recording
from model_training.importing.take import scans_of
from model_training.importing.trajectory import Trajectory
from model_training.odometry.keyframes import drive_of
from model_training.odometry.loops import find_loops
from model_training.odometry.pose_graph import closed, disagreement_m
from model_training.odometry.scan_to_map import posed
from model_training.stock import ENCODER
from service.errors import DatasetError
from service.imaging.pca import USUAL_LIDAR_HEIGHT_M
from service.retrieval.encoder import Encoder

Report = Callable[[str, int, int], None]


@dataclass(frozen=True, slots=True)
class TrajectoryResult:
    """Result of odometry and loop closure.

    Attributes:
        trajectory: T_map_vehicle after loop closure. The map frame is the LiDAR frame of the first scan.
        before: T_map_vehicle before loop closure.
        loops: number of verified loops.
        disagreement_m: mean distance between odometry and the loops, metres: before and after loop closure.
    """

    trajectory: Trajectory
    before: Trajectory
    loops: int
    disagreement_m: tuple[float, float]


def find_trajectory(
    recording: Recording,
    *,
    close_loops: bool = True,
    expected_height_m: float = USUAL_LIDAR_HEIGHT_M,
    report: Report = lambda *_: None,
) -> TrajectoryResult:
    """Follow the scans of a recording, and close loops at places that the traversal visits again.

    Args:
        recording: its own poses are not used.
        close_loops: False keeps the odometry as it is.
        expected_height_m: approximate height of the LiDAR above the ground, metres.
        report: called with the stage, the steps done and all steps.

    Raises:
        DatasetError: there is no usable scan.
    """
    mounted = recording.lidar.T_vehicle_sensor
    T_vehicle_lidar = np.eye(4) if mounted is None else np.array(mounted, np.float64)
    encoder = Encoder.open(ENCODER, threads=2) if close_loops else None
    total = recording.count()
    with tempfile.TemporaryDirectory(prefix="streetfix-odometry-") as folder:
        drive = drive_of(
            posed(scans_of(recording)),
            encoder,
            Path(folder),
            expected_height_m=expected_height_m,
            report=lambda done: report("odometry", done, max(done, total)),
        )
        if not len(drive.stamps_s):
            raise DatasetError("no scan is usable, so odometry is not possible", field="scans")
        name = "odometry (KISS-ICP)"
        before = Trajectory(drive.stamps_s, drive.T_first_lidar, name).moved_by(T_vehicle_lidar)
        loops = find_loops(drive, report=lambda done, of: report("loops", done, of)) if close_loops else []
        if not loops:
            return TrajectoryResult(before, before, 0, (0.0, 0.0))
        T = closed(drive, loops)
        rows = np.searchsorted(drive.stamps_s, [keyframe.stamp_s for keyframe in drive.keyframes])
        away = (disagreement_m(drive.T_first_lidar[rows], loops), disagreement_m(T[rows], loops))
        after = Trajectory(drive.stamps_s, T, f"{name}, {len(loops)} loops closed").moved_by(T_vehicle_lidar)
        return TrajectoryResult(after, before, len(loops), away)
