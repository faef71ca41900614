"""Measure the drift of a simulated survey without poses: by odometry alone, and with loop closure."""

import numpy as np
from numpy.typing import NDArray

from benchmarks.real.loop_drive import LoopDrive
from benchmarks.report import Report
from model_training.cli.progress import bars
from model_training.odometry.find import find_trajectory

SEED, LENGTH_M = 9101, 1500.0


def loop_rows(report: Report) -> None:
    """Add the position RMSE after rigid alignment, as ``evo_ape --align`` computes it, before and after loop closure.

    Args:
        report: receives the rows.
    """
    drive = LoopDrive(SEED, length_m=LENGTH_M)
    with bars() as show:
        found = find_trajectory(drive, report=show)
    truth = drive.T_map_lidar[:, :3, 3]
    before, after = (aligned_error_m(t.T_map_vehicle[:, :3, 3], truth) for t in (found.before, found.trajectory))
    report.row("loop_closure.drift_before_m", before, "m", n=len(truth))
    report.row("loop_closure.drift_after_m", after, "m", bar=0.30, better="lower", n=len(truth))
    report.row("loop_closure.loops", found.loops, "loops")


def aligned_error_m(estimated: NDArray[np.float64], truth: NDArray[np.float64]) -> float:
    """Return the RMSE after the rigid alignment that minimises it (Umeyama 1991, without scale), metres.

    Args:
        estimated: positions (n, 3), metres.
        truth: ground-truth positions (n, 3), metres.
    """
    a, b = estimated - estimated.mean(axis=0), truth - truth.mean(axis=0)
    u, _, vt = np.linalg.svd(b.T @ a)
    R = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    return float(np.sqrt(((a @ R.T - b) ** 2).sum(axis=1).mean()))
