"""Tiled builds: the same map although processes are killed, Ray against processes of this machine, and memory for four towns."""

import importlib.util
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import numpy as np

from benchmarks.report import ROOT, Report
from benchmarks.runs import Runs
from benchmarks.scale.town import watched_build
from model_training.datasets.dataset import Dataset, scan_path, write_tum
from model_training.mapping.build_tiled import build_tiled
from model_training.mapping.engines import Engine
from model_training.mapping.settings import BuildSettings
from model_training.simulation.plan import SimulationPlan
from model_training.stock import ENCODER
from model_training.training.recipe import EVALUATION_SEEDS
from service.maps.manifest import read_manifest

#: Rows of this part and their units.
BARRED = {"build.kill_runs_identical": "runs", "build.ray_over_local_throughput": "ratio"}
#: Runs in which something is killed.
RUNS = 20
#: Rounds of each engine. The fastest one counts.
ROUNDS = 2
#: Towns of the comparison of memory, and the distance between them, metres.
TOWNS, APART_M = 4, 2000.0
#: Edge of the tiles of all these maps, metres.
_TILE_M = 60.0


def built_rows(report: Report, runs: Runs) -> None:
    """Add the rows of tiled builds.

    Args:
        report: collects the rows.
        runs: simulates the cities, or reuses them.
    """
    _killed(report, runs.dataset(_plan("killed-tiles", 60, (60.0, 60.0), ("1",))), runs.work / "tiles")
    _against_ray(report, runs.dataset(timed_plan()), runs.work / "tiles")


def timed_plan() -> SimulationPlan:
    """Plan the small town whose build is timed, and whose memory is compared with that of four towns."""
    return _plan("timed-tiles", 61, (150.0, 150.0), ())


def _plan(name: str, seed: int, size_m: tuple[float, float], streets: tuple[str, ...]) -> SimulationPlan:
    return SimulationPlan(
        name=name, seed=EVALUATION_SEEDS[seed], size_m=size_m, spacing_m=3.0, lidar="vlp_16", streets=streets
    )


def _killed(report: Report, dataset: Dataset, work: Path) -> None:
    """Kill a tile's process in every second run, and the whole build in the others. The next command goes on."""
    draw = random.Random(39)  # noqa: S311  # moments, not secrets
    out = work / "killed"
    shutil.rmtree(work, ignore_errors=True)
    began = time.monotonic()
    _finished(_started(dataset, out))
    took_s = time.monotonic() - began
    expected, same, restarted = read_manifest(out), 0, 0
    for number in range(RUNS):
        shutil.rmtree(out)
        process = _started(dataset, out)
        time.sleep(draw.uniform(0.1, 0.95) * took_s)
        victims = _tile_processes(process.pid) if number % 2 else [process.pid]
        with suppress(ProcessLookupError):  # it has just ended
            if victims:
                os.kill(draw.choice(victims), signal.SIGKILL)
        if process.wait() != 0:
            restarted += 1
            _finished(_started(dataset, out))
        made = read_manifest(out)
        tiles = [(tile.column, tile.row, tile.version) for tile in made.tiles]
        alike = tiles == [(tile.column, tile.row, tile.version) for tile in expected.tiles]
        same += alike and made.version == expected.version
    report.row(
        "build.kill_runs_identical",
        same,
        BARRED["build.kill_runs_identical"],
        bar=RUNS,
        n=RUNS,
        why=f"{len(expected.tiles)} tiles; in {restarted} runs the whole build was killed and the command given again",
    )
    shutil.rmtree(work)


def _started(dataset: Dataset, out: Path) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-c", "from service.cli.start import main; main()", "build-map", str(dataset.folder)]
    command += ["--out", str(out), "--headings", "6", "--tile-m", f"{_TILE_M:g}", "--workers", "2"]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def _finished(process: subprocess.Popen[bytes]) -> None:
    if process.wait() != 0:
        raise RuntimeError(f"the build ended with code {process.returncode}: {process.args!r}")


def _tile_processes(parent: int) -> list[int]:
    """Return the processes that build tiles for a process."""
    found = []
    for folder in Path("/proc").iterdir():
        with suppress(OSError, ValueError):  # not a process, or one that has ended
            pid = int(folder.name)
            status = (folder / "stat").read_text().rpartition(")")[2].split()
            if int(status[1]) == parent and b"spawn_main" in (folder / "cmdline").read_bytes():
                found.append(pid)
    return found


def _against_ray(report: Report, dataset: Dataset, work: Path) -> None:
    """Time both engines in turn, with as many tiles at once as cores. Ray runs already."""
    row_id = "build.ray_over_local_throughput"
    if importlib.util.find_spec("ray") is None:
        report.absent(row_id, BARRED[row_id], 'needs Ray: pip install ".[ray]"')
        return
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_worker_niceness", "0")  # as that of the processes
    import ray

    cores = len(os.sched_getaffinity(0))
    ray.init(address="local", num_cpus=cores, include_dashboard=False, log_to_driver=False)
    took: dict[Engine, list[float]] = {"local": [], "ray": []}
    versions = set()
    settings = BuildSettings(name=dataset.name)
    for _ in range(ROUNDS):
        for engine, times in took.items():
            shutil.rmtree(work, ignore_errors=True)
            began = time.monotonic()
            made = build_tiled(
                dataset, ENCODER, work / engine, settings, tile_m=_TILE_M, engine=engine, workers=cores, warn=print
            )
            times.append(time.monotonic() - began)
            versions.add(made.version)
    ray.shutdown()
    shutil.rmtree(work)
    local_s, ray_s = min(took["local"]), min(took["ray"])
    equal = "equal" if len(versions) == 1 else "DIFFERENT"
    report.row(
        row_id,
        local_s / ray_s,
        BARRED[row_id],
        bar=0.9,
        n=ROUNDS,
        why=f"{local_s:.0f} s with processes, {ray_s:.0f} s with Ray, {len(made.tiles)} tiles, {cores} cores; versions are {equal}",
    )


def four_towns_row(report: Report, town: Dataset, work: Path) -> None:
    """Compare the peak memory of the build of four towns with that of one.

    Args:
        report: collects the row.
        town: dataset of one town.
        work: folder for the builds; it is removed.
    """
    shutil.rmtree(work, ignore_errors=True)
    four = copied(town, work / "four", TOWNS)
    peaks = [
        watched_build(each, work / f"{name}-map", tile_m=_TILE_M)[1] for name, each in (("one", town), ("four", four))
    ]
    scans = len(town.survey_poses())
    report.row(
        "town.build_peak_four_towns_over_one",
        peaks[1] / peaks[0],
        "ratio",
        bar=1.1,
        better="lower",
        n=TOWNS,
        why=f"{peaks[1] / 2**20:.0f} over {peaks[0] / 2**20:.0f} MiB; a small town of {scans} scans in tiles of {_TILE_M:g} m",
    )
    shutil.rmtree(work)


def copied(town: Dataset, folder: Path, count: int) -> Dataset:
    """Write a dataset of several copies of a town, ``APART_M`` apart along x. Its scans are links to those of the town.

    Args:
        town: dataset of the town.
        folder: folder to write.
        count: number of copies.
    """
    scans = folder / "survey" / "scans"
    scans.mkdir(parents=True)
    shutil.copy(town.folder / "dataset.json", folder)
    stamps, T_map_lidar = town.survey_trajectory()
    every_s = float(stamps[-1] - stamps[0]) + 60.0
    moved = []
    for copy in range(count):
        T = T_map_lidar.copy()
        T[:, 0, 3] += copy * APART_M
        moved.append(T)
        for number in range(len(T)):
            os.link(scan_path(town.folder, number), scan_path(folder, copy * len(T) + number))
    write_tum(
        folder / "survey" / "poses.txt",
        np.concatenate([stamps + copy * every_s for copy in range(count)]),
        np.concatenate(moved),
    )
    return Dataset(folder)
