"""How long a map takes to learn the confidence of a new rig from rendered images: ``streetfix calibrate --map M --rig rig.json``."""

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.plans import height_plan
from benchmarks.report import Report
from benchmarks.runs import Runs

#: Bar of issue 38 (docs/decisions), seconds on a map with at least this length of traversal, metres.
_SECONDS, _LEAST_M = 30.0, 1000.0
#: A stereo camera that the calibration has not met.
RIG = {
    "name": "front stereo",
    "camera": {"width": 1280, "height": 720, "fx": 700, "fy": 700, "cx": 639.5, "cy": 359.5, "height_m": 0.9},
    "depth": {"noise_px": 0.25, "baseline_m": 0.12, "min_range_m": 0.4, "max_range_m": 20},
    "rectified": True,
}


def rig_calibration_rows(report: Report, runs: Runs) -> None:
    """Add the time of the command, from its start to its end.

    Args:
        report: collects the rows.
        runs: simulates, builds and answers, or reuses what is kept on disk.

    Raises:
        ValueError: the traversal of the map is shorter than a kilometre.
        CalledProcessError: the command fails.
    """
    dataset = runs.dataset(height_plan(1.5))
    folder = runs.bundle(dataset).path
    steps_m = np.linalg.norm(np.diff(dataset.survey_poses()[:, :2, 3], axis=0), axis=1)
    # A step to the next street is no street.
    street_m = float(steps_m[steps_m < 10 * np.median(steps_m)].sum())
    if street_m < _LEAST_M:
        raise ValueError(f"{dataset.folder}: a traversal of {street_m:.0f} m is shorter than {_LEAST_M:.0f} m")
    with tempfile.TemporaryDirectory() as temporary:
        rig = Path(temporary) / "rig.json"
        rig.write_text(json.dumps(RIG))
        out = rig.with_name("calibration.json")
        command = ("calibrate", "--map", str(folder), "--rig", str(rig), "--out", str(out))
        began = time.perf_counter()
        subprocess.run([Path(sys.executable).with_name("streetfix"), *command], check=True, stdout=subprocess.DEVNULL)
        seconds = time.perf_counter() - began
    report.row(
        "rig.calibration_s", seconds, "s", bar=_SECONDS, better="lower", n=1, why=f"traversal of {street_m:.0f} m"
    )
