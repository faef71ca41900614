"""Tiled builds: the same map although processes are killed, Ray against processes of this machine, and memory for four towns."""

import importlib.util
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.report import ROOT, Report
from benchmarks.runs import Runs
from benchmarks.scale.town import watched_build
from model_training.datasets.dataset import Dataset, scan_path, write_tum
from model_training.loadtest.processes import descendants
from model_training.mapping.build_tiled import build_tiled
from model_training.mapping.settings import BuildSettings
from model_training.simulation.plan import SimulationPlan
from model_training.stock import ENCODER
from model_training.tasks.engines import Engine
from model_training.training.recipe import EVALUATION_SEEDS
from service.errors import RequestError
from service.maps.manifest import Manifest, read_manifest

#: Rows of this part and their units.
BARRED = {"build.kill_runs_identical": "runs", "build.ray_over_local_throughput": "ratio"}
#: Runs in which something is killed, and most tries of a run: a try counts only if a process was really killed.
RUNS, TRIES = 20, 20
#: Rounds of each engine. The fastest one counts.
ROUNDS = 2
#: Towns of the comparison of memory, and the distance between them, metres.
TOWNS, APART_M = 4, 2000.0
#: Edge of the tiles of all these maps, metres.
_TILE_M = 60.0
#: Time between two looks at the processes of an undisturbed build, s.
_LOOK_S = 0.05


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


@dataclass(frozen=True, slots=True)
class Kill:
    """What a run kills.

    Attributes:
        name: what it kills, for the report.
        engine: engine of the build.
        victims: returns the processes of a build from which one is drawn.
        told: what the build says after the death of such a process; None if the build itself dies.
    """

    name: str
    engine: Engine
    victims: Callable[[int], list[int]]
    told: str | None


def kills() -> list[Kill]:
    """Return what the runs kill in turn. Without Ray there is no worker of Ray."""
    found = [
        Kill("whole builds", "local", lambda build: [build], None),
        Kill("tile processes", "local", lambda build: processes_with(build, b"spawn_main"), "was killed by SIGKILL"),
    ]
    if importlib.util.find_spec("ray") is not None:
        worker = Kill(
            "Ray workers", "ray", lambda build: processes_with(build, b"ray::_in_task"), "was lost (WorkerCrashedError)"
        )
        found.append(worker)
    return found


def _killed(report: Report, dataset: Dataset, work: Path) -> None:
    """Kill a process in every run. A build that was killed itself is started again. The maps must have the same versions."""
    draw = random.Random(39)  # noqa: S311  # moments, not secrets
    out, log, chosen = work / "killed", work / "build.log", kills()
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    window_s = {}
    for kill in reversed(chosen):  # the last build is a local one, whose map is expected
        window_s[kill.name] = window_of(kill, _started_anew(dataset, out, kill.engine, log), log)
    expected, same, in_vain = _versions(read_manifest(out)), 0, 0
    killed = dict.fromkeys((kill.name for kill in chosen), 0)
    for number in range(RUNS):
        kill = chosen[number % len(chosen)]
        start = partial(_started_anew, dataset, out, kill.engine, log)
        in_vain += killed_run(kill, start, log, draw, window_s[kill.name])
        killed[kill.name] += 1
        if kill.told is None:
            require_success(_started(dataset, out, kill.engine, log), log)
        same += _versions(read_manifest(out)) == expected
    counts = ", ".join(f"{count} {name}" for name, count in killed.items())
    report.row(
        "build.kill_runs_identical",
        same,
        BARRED["build.kill_runs_identical"],
        bar=RUNS,
        n=RUNS,
        why=f"{len(expected) - 1} tiles; killed: {counts}. A build that was killed itself was started again. {in_vain} more tries found no "
        "process to kill and do not count",
    )
    shutil.rmtree(work)


def window_of(kill: Kill, process: subprocess.Popen[bytes], log: Path) -> tuple[float, float]:
    """Wait for the end of an undisturbed build. Return the first and the last time at which it had a process to kill, s from its start.

    Args:
        kill: what would be killed.
        process: the build, just started.
        log: file with what the build says.

    Raises:
        RuntimeError: the build failed, or there was nothing to kill.
    """
    began, seen = time.monotonic(), []
    while process.poll() is None:
        with suppress(RequestError):  # it has just ended
            if kill.victims(process.pid):
                seen.append(time.monotonic() - began)
        time.sleep(_LOOK_S)
    require_success(process, log)
    if not seen:
        raise RuntimeError(f"{kill.name}: the build had none to kill; it may be too short, so choose a larger city")
    return seen[0], seen[-1]


def killed_run(
    kill: Kill,
    start: Callable[[], subprocess.Popen[bytes]],
    log: Path,
    draw: random.Random,
    window_s: tuple[float, float],
) -> int:
    """Start a build, kill a process of it at a random moment, and wait for its end. Repeat this until a process was really killed.

    Args:
        kill: what is killed.
        start: starts the build from the beginning.
        log: file with what the build says.
        draw: draws the moment and the process.
        window_s: first and last time at which an undisturbed build has a process to kill, s from its start.

    Returns:
        Number of tries in which no process was killed, because there was none or it had ended.

    Raises:
        RuntimeError: nothing was killed in ``TRIES`` tries, or a build failed for another reason.
    """
    for in_vain in range(TRIES):
        process = start()
        try:
            time.sleep(draw.uniform(*window_s))
            victims = kill.victims(process.pid) if process.poll() is None else []
            with suppress(ProcessLookupError):  # it has just ended
                if victims:
                    os.kill(draw.choice(victims), signal.SIGKILL)
            code = process.wait()
        finally:
            process.kill()
        if kill.told is None and code == -signal.SIGKILL:
            return in_vain
        require_success(process, log)
        if kill.told is not None and kill.told in log.read_text(errors="replace"):
            return in_vain
    raise RuntimeError(
        f"{kill.name}: nothing was killed in {TRIES} tries; the build may be too short, so choose a larger city"
    )


def _versions(made: Manifest) -> list[tuple[int, int, str]]:
    """Return the version of each tile with its column and row, and that of the map."""
    return [*((tile.column, tile.row, tile.version) for tile in made.tiles), (-1, -1, made.version)]


def _started_anew(dataset: Dataset, out: Path, engine: Engine, log: Path) -> subprocess.Popen[bytes]:
    shutil.rmtree(out, ignore_errors=True)
    return _started(dataset, out, engine, log)


def _started(dataset: Dataset, out: Path, engine: Engine, log: Path) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-c", "from service.cli.start import main; main()", "build-map", str(dataset.folder)]
    command += ["--out", str(out), "--headings", "6", "--tile-m", f"{_TILE_M:g}", "--workers", "2", "--engine", engine]
    environment = {name: value for name, value in os.environ.items() if name != "RAY_ADDRESS"}
    with log.open("wb") as stream:
        return subprocess.Popen(command, cwd=ROOT, env=environment, stdout=subprocess.DEVNULL, stderr=stream)


def require_success(process: subprocess.Popen[bytes], log: Path) -> None:
    """Wait for the end of a build.

    Args:
        process: the build.
        log: file with what it says.

    Raises:
        RuntimeError: it failed.
    """
    if process.wait() != 0:
        raise RuntimeError(
            f"the build ended with code {process.returncode}: {process.args!r}\n{log.read_text(errors='replace')[-2000:]}"
        )


def processes_with(ancestor: int, text: bytes) -> list[int]:
    """Return the descendants of a process whose command line has a text.

    Args:
        ancestor: number of the process.
        text: part of the command line.
    """
    found = []
    for pid in descendants(ancestor) - {ancestor}:
        with suppress(OSError):  # it has ended
            if text in Path(f"/proc/{pid}/cmdline").read_bytes():
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
    versions: dict[Engine, set[str]] = {"local": set(), "ray": set()}
    settings = BuildSettings(name=dataset.name)
    for _ in range(ROUNDS):
        for engine, times in took.items():
            shutil.rmtree(work, ignore_errors=True)
            began = time.monotonic()
            made = build_tiled(
                dataset, ENCODER, work / engine, settings, tile_m=_TILE_M, engine=engine, workers=cores, warn=print
            )
            times.append(time.monotonic() - began)
            versions[engine].add(made.version)
    ray.shutdown()
    shutil.rmtree(work)
    require_one_version(versions)
    local_s, ray_s = min(took["local"]), min(took["ray"])
    report.row(
        row_id,
        local_s / ray_s,
        BARRED[row_id],
        bar=0.9,
        n=ROUNDS,
        why=f"{local_s:.0f} s with processes, {ray_s:.0f} s with Ray, {len(made.tiles)} tiles, {cores} cores; all maps are equal",
    )


def require_one_version(versions: Mapping[Engine, set[str]]) -> None:
    """Refuse maps of different versions.

    Args:
        versions: versions of the maps that each engine built.

    Raises:
        RuntimeError: the versions differ. Then a comparison of the engines means nothing.
    """
    if len(set().union(*versions.values())) != 1:
        told = "; ".join(f"{engine}: {', '.join(sorted(found))}" for engine, found in versions.items())
        raise RuntimeError(f"the engines built different maps ({told}); find the cause before you compare their times")


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
