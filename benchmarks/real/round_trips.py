"""Write a simulated dataset in other formats, import it again, and measure what changes."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np

from benchmarks.report import ROOT, Report
from model_training.datasets.dataset import Dataset
from model_training.evaluation.predict import predict
from model_training.exporting.kitti_raw import DAY, DRIVE, POSES, write_kitti_raw
from model_training.exporting.ros_bag import write_bag
from model_training.importing.kinds import OpenSettings, open_recording
from model_training.importing.pose_file import read_pose_file
from model_training.importing.take import TakeSettings, take
from model_training.mapping.build import build_map
from model_training.mapping.settings import BuildSettings
from model_training.simulation.plan import QueryPlan, SimulationPlan
from model_training.simulation.simulate import simulate
from model_training.stock import ENCODER
from service.localization.localizer import Localizer
from service.maps.reader import MapBundle

QUERIES = "drive1_precise"
#: Numbers of scans of the two bags that are imported to measure time and memory.
SHORT, LONG = 500, 5000


def round_trip_rows(report: Report, work: Path) -> None:
    """Add the largest difference between answers before and after the round trip, for each format.

    Args:
        report: receives the rows.
        work: folder of datasets and maps.
    """
    original = simulated(work)
    expected = _answers(original, QUERIES, work / "round_trip_map")
    for kind in ("mcap", "bag", "kitti"):
        again = _round_trip(original, kind, work)
        found = _answers(again, "recorded", work / f"round_trip_{kind}_map")
        away = np.linalg.norm(found[:, :3, 3] - expected[:, :3, 3], axis=1)
        report.row(f"roundtrip.{kind}.pose_difference_m", float(away.max()), "m", bar=0.01, better="lower", n=len(away))


def import_rows(report: Report, work: Path) -> None:
    """Add the import rate of a bag (scans per second), and the growth of memory from ``SHORT`` to ``LONG`` scans.

    Args:
        report: receives the rows.
        work: folder of datasets.
    """
    original = simulated(work)
    peaks, rates = {}, {}
    for scans in (SHORT, LONG):
        bag, out = work / f"many_{scans}_bag", work / f"many_{scans}"
        for path in (bag, out):
            shutil.rmtree(path, ignore_errors=True)
        _repeated(original, scans, bag)
        rates[scans], peaks[scans] = _import_in_process(bag, out)
        for path in (bag, out):
            shutil.rmtree(path)
    report.row("import.scans_per_s", rates[LONG], "1/s", bar=50, n=LONG)
    growth = peaks[LONG] - peaks[SHORT]
    report.row("import.memory_growth_mib", growth, "MiB", bar=50, better="lower", n=LONG)
    report.row("import.peak_mib", peaks[LONG], "MiB", n=LONG)


def simulated(work: Path, street: str = "1") -> Dataset:
    """Simulate one street of the paper's city with one query drive.

    Args:
        work: folder of datasets.
        street: name of the street.
    """
    query = QueryPlan(name="drive1", traversal=1, count=40, depths=("precise",))
    plan = SimulationPlan(name=f"street-{street}", city="paper", seed=9090, streets=(street,), queries=(query,))
    folder = work / plan.name
    simulate(plan, folder)
    return Dataset(folder)


def _round_trip(original: Dataset, kind: str, work: Path) -> Dataset:
    suffix = ".bag" if kind == "bag" else "_there"
    there, back = work / f"round_trip_{kind}{suffix}", work / f"round_trip_{kind}"
    for path in (there, back):
        if path.is_file():
            path.unlink()
        shutil.rmtree(path, ignore_errors=True)
    if kind == "kitti":
        write_kitti_raw(original, QUERIES, there, report=lambda *_: None)
        recording = open_recording("kitti-raw", there / DAY / DRIVE, OpenSettings(depth="stored"))
        poses = read_pose_file(there / DAY / DRIVE / POSES)
    else:
        write_bag(original, QUERIES, there, kind="mcap" if kind == "mcap" else "bag", report=lambda *_: None)
        recording = open_recording("rosbag", there, OpenSettings())
        trajectory = recording.trajectory()
        if trajectory is None:
            raise RuntimeError(f"the bag of {kind} was read back without its poses")
        poses = trajectory
    take(recording, poses, back, TakeSettings())
    return Dataset(back)


def _answers(dataset: Dataset, queries: str, bundle: Path) -> np.ndarray:
    shutil.rmtree(bundle, ignore_errors=True)
    build_map(dataset, ENCODER, bundle, BuildSettings(name="round-trip"))
    return predict(Localizer.open(MapBundle.open(bundle)), dataset, queries).T_answer


class _Repeated(Dataset):
    """A dataset whose survey repeats, for a long bag."""

    def __init__(self, folder: Path, scans: int) -> None:
        super().__init__(folder)
        self._scans = scans

    def survey_trajectory(self) -> tuple[np.ndarray, np.ndarray]:
        _, poses = super().survey_trajectory()
        rows = np.arange(self._scans) % len(poses)
        return np.arange(self._scans) * 0.1, poses[rows]

    def scan(self, number: int) -> np.ndarray:
        return super().scan(number % len(super().survey_trajectory()[0]))


def _repeated(original: Dataset, scans: int, out: Path) -> None:
    write_bag(_Repeated(original.folder, scans), None, out, kind="mcap", report=lambda *_: None)


def _import_in_process(bag: Path, out: Path) -> tuple[float, float]:
    """Run the import command in its own process; return scans per second and peak memory (MiB).

    ``VmHWM`` starts anew with the command. ``ru_maxrss`` of a child begins with the memory of its parent.
    """
    code = (
        "import json, pathlib, re, sys, time\n"
        "from service.cli.main import main\n"
        "began = time.perf_counter()\n"
        "try:\n    main(sys.argv[1:])\nexcept SystemExit as end:\n    assert not end.code, end.code\n"
        "peak = re.search(r'VmHWM:\\s+(\\d+) kB', pathlib.Path('/proc/self/status').read_text())[1]\n"
        "print(json.dumps([time.perf_counter() - began, int(peak)]))"
    )
    command = [sys.executable, "-c", code, "import", "rosbag", str(bag), "--out", str(out), "--no-pictures"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    seconds, peak_kib = json.loads(done.stdout.splitlines()[-1])
    return len(Dataset(out).survey_poses()) / seconds, peak_kib / 1024
