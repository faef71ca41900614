"""The town: 20 km of streets in a square kilometre, built in tiles, served, and asked."""

import os
import subprocess
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from itertools import islice
from pathlib import Path

import numpy as np

from benchmarks.plans import BOTH
from benchmarks.report import ROOT, Report
from benchmarks.runs import MAPPING, Runs, accepted_within, code_hash, pooled, share, within
from benchmarks.serving.machines import Server, peak_mib
from benchmarks.serving.sizes import STARTS
from model_training.datasets.dataset import Dataset, QueryFrame
from model_training.evaluation.measures import measure
from model_training.evaluation.priors import prior_with_std
from model_training.simulation.plan import QueryPlan, SimulationPlan
from model_training.training.recipe import EVALUATION_SEEDS
from service.client import Client
from service.contract.schema import Camera, LocalizeAnswer
from service.maps.content import NOT_SERVED
from service.maps.manifest import Manifest, read_manifest
from service.maps.tiles import TiledMap
from service.retrieval.encoder import Encoder

#: Extent of the town, m; queries with each depth camera; sequences of frames.
TOWN_M, QUERIES, SEQUENCES, FRAMES = (1000.0, 1000.0), 500, 100, 5
#: Edge of the tiles (m), limit of the open tiles under load (bytes), queries of this load, and clients that send them.
TILE_M, OPEN_BYTES, LOAD, CLIENTS = 500.0, 512 * 2**20, 150, 4
#: Time between two looks at the memory of a build, s.
_LOOK_S = 1.0
#: Standard deviation of a prior, metres: that of GNSS between houses.
PRIOR_M = 50.0
#: Bars of the accuracy: share within 1 m and recall at 1, by depth camera.
_BARS = {"precise": (0.985, 0.985), "stereo": (0.965, 0.96)}


def town_plan() -> SimulationPlan:
    """Plan the town: a survey with 32 beams, another traversal with single frames, and one with sequences of five frames."""
    queries = (
        QueryPlan(name="drive1", traversal=1, count=QUERIES, depths=BOTH),
        QueryPlan(name="sequence5", traversal=2, count=SEQUENCES, sequence=FRAMES, step_m=2.0, depths=("stereo",)),
    )
    return SimulationPlan(name="town", seed=EVALUATION_SEEDS[50], size_m=TOWN_M, queries=queries)


def town_folder(runs: Runs) -> Path:
    """Return the folder of the town's map, which depends on the encoder and the code of the map build.

    Args:
        runs: the encoder, and the folder of maps.
    """
    return runs.work / "maps" / f"town-tiled-{Encoder.open(runs.encoder).sha256[:12]}-{code_hash(*MAPPING)}"


def town_rows(report: Report, runs: Runs) -> None:
    """Build the town if it is not kept, and add all its rows.

    Args:
        report: collects the rows. It is written after each step.
        runs: simulates and answers, or reuses what is kept on disk.
    """
    dataset, folder = runs.dataset(town_plan()), town_folder(runs)
    if not folder.exists():
        _build(report, dataset, folder)
        report.write()
    read = read_manifest(folder)
    metres = read.counts.places * read.spacing_m
    report.row(
        "town.kb_per_metre",
        served_bytes(folder, read) / 1e3 / metres,
        "kB/m",
        bar=25,
        better="lower",
        why=f"{len(read.tiles)} tiles of {TILE_M:g} m, {metres / 1e3:.1f} km of streets; equal files, such as the encoder of each tile, "
        "are links to one file and count once",
    )
    open_rows(report, folder, dataset)
    report.write()
    _accuracy_rows(report, runs, dataset, folder)


def _build(report: Report, dataset: Dataset, out: Path) -> None:
    minutes, peak = watched_build(dataset, out, "--name", "town", tile_m=TILE_M)
    report.row("town.build_minutes", minutes, "min", bar=12, better="lower", n=len(dataset.survey_poses()))
    read, cores = read_manifest(out), len(os.sched_getaffinity(0))
    km = read.counts.places * read.spacing_m / 1e3
    report.row(
        "town.build_core_hours_per_km",
        minutes / 60 * cores / km,
        "h/km",
        why=f"at most: all {cores} cores count as busy",
    )
    report.row("town.build_peak_gib", peak / 2**30, "GiB", bar=2, better="lower")


def watched_build(dataset: Dataset, out: Path, *options: str, tile_m: float) -> tuple[float, int]:
    """Build a tiled map in another process. Return its time, minutes, and the peak memory of it and its children, bytes.

    Args:
        dataset: dataset to map.
        out: folder of the map; it must not exist.
        *options: further options of ``build-map``.
        tile_m: edge of the tiles, metres.
    """
    out.parent.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-c", "from service.cli.start import main; main()", "build-map", str(dataset.folder)]
    command += ["--out", str(out), "--tile-m", f"{tile_m:g}", *options]
    began, peak = time.monotonic(), 0
    process = subprocess.Popen(command, cwd=ROOT)
    while process.poll() is None:
        peak = max(peak, memory_of_tree(process.pid))
        time.sleep(_LOOK_S)
    if process.returncode:
        raise RuntimeError(f"the build of {dataset.folder} ended with code {process.returncode}")
    return (time.monotonic() - began) / 60, peak


def memory_of_tree(pid: int) -> int:
    """Return the memory of a process and of all its descendants, bytes. Shared pages count once (PSS).

    Args:
        pid: number of the process.
    """
    total, waiting = 0, [pid]
    while waiting:
        number = waiting.pop()
        with suppress(OSError):  # it has ended
            fields = Path(f"/proc/{number}/smaps_rollup").read_text().split()
            total += 1024 * int(fields[fields.index("Pss:") + 1])
            for task in Path(f"/proc/{number}/task").iterdir():
                waiting += [int(child) for child in (task / "children").read_text().split()]
    return total


def served_bytes(folder: Path, read: Manifest) -> int:
    """Return the size of the files that the service reads, bytes. Files with one hash are one file, with a link in each tile.

    Args:
        folder: folder of the tiled map.
        read: its manifest.
    """
    tiles = [read_manifest(folder / tile.folder).files for tile in read.tiles]
    served = {
        entry.sha256: entry.size
        for files in (read.files, *tiles)
        for name, entry in files.items()
        if name not in NOT_SERVED
    }
    return sum(served.values())


def open_rows(report: Report, folder: Path, dataset: Dataset) -> None:
    """Add time to ready and peak memory under load, of the real command. The command is ended, also after an error.

    Args:
        report: collects the rows.
        folder: folder of the map.
        dataset: dataset with the queries.
    """
    frames, ready_s = list(islice(dataset.queries("drive1_precise"), LOAD)), []
    for _ in range(STARTS - 1):
        with Server(folder, core=None, workers=1, open_tile_bytes=OPEN_BYTES) as server:
            ready_s.append(server.ready_s)
    with Server(folder, core=None, workers=1, open_tile_bytes=OPEN_BYTES) as server:
        answers = ask(server.url, frames, CLIENTS)
        peak = peak_mib(server.process.pid)
        ready_s.append(server.ready_s)
    why = "`streetfix serve` with one worker, from the start of the process until /readyz answers 200; median"
    report.row("town.ready_s", float(np.median(ready_s)), "s", bar=2, better="lower", n=STARTS, why=why)
    accepted = sum(answer.status == "LOCALIZED" for answer in answers)
    report.row(
        "town.resident_mib",
        peak,
        "MiB",
        bar=1000,
        better="lower",
        n=len(answers),
        why=f"VmHWM, the largest resident memory of the service since its start, with pages of the map. {len(answers)} queries without a "
        f"prior from {CLIENTS} clients over REST, {accepted} of them LOCALIZED; at most {OPEN_BYTES / 2**20:.0f} MiB of tiles are open",
    )


def ask(url: str, frames: Sequence[QueryFrame], clients: int) -> list[LocalizeAnswer]:
    """Send queries without a prior from several clients at the same time; return the answers in the order of the queries.

    Args:
        url: address of the service.
        frames: the queries.
        clients: number of clients. Each waits for its answer before it sends the next query.

    Raises:
        StreetfixError: a query was not answered.
    """

    def one(frame: QueryFrame) -> LocalizeAnswer:
        depth = frame.camera.depth
        return client.localize(
            frame.rgb_path.read_bytes(),
            frame.depth_path.read_bytes(),
            Camera(**frame.request()["camera"]),
            depth_scale_m=depth.scale_m,
            depth_kind=depth.kind,
            max_range_m=depth.max_range_m,
            baseline_m=depth.baseline_m,
        )

    with Client(url) as client, ThreadPoolExecutor(clients) as threads:
        return list(threads.map(one, frames))


def _accuracy_rows(report: Report, runs: Runs, dataset: Dataset, folder: Path) -> None:
    opened = TiledMap.open(folder)
    classes = [] if opened.streets is None else [street.name for street in opened.streets.features]
    for depth, (within_bar, recall) in _BARS.items():
        answers = runs.predictions(opened, dataset, f"drive1_{depth}")
        figures, row = measure(answers, classes), f"town.{depth}"
        share(report, f"{row}.within_1_m", figures, "within_1_m", within_bar)
        share(report, f"{row}.recall_at_1_5m", figures, "recall_at_1_5m", recall)
        value, count, interval = pooled([figures], "recall_at_10_5m")
        report.row(f"{row}.recall_at_10_5m", value, "share", n=count, ci95=interval)
        report.share(f"{row}.forced_within_1_m", within(answers, 1.0))
        wrong = answers.localized & ~accepted_within(answers, 1.0)
        report.share(f"{row}.wrong_and_accepted", wrong, bar=0.002 if depth == "precise" else None, better="lower")
        off = np.linalg.norm(answers.T_answer[:, :2, 3] - answers.T_true[:, :2, 3], axis=1)[answers.localized]
        report.row(
            f"{row}.mean_distance_error_m",
            float(off.mean()) if len(off) else None,
            "m",
            bar=0.3 if depth == "precise" else None,
            better="lower",
            n=len(off),
            why="answered queries",
        )
        report.write()
        told = runs.predictions(
            opened, dataset, f"drive1_{depth}", prior=(f"near-{PRIOR_M:g}", prior_with_std(PRIOR_M))
        )
        report.share(f"town.prior_{PRIOR_M:g}_m.{depth}.within_1_m", accepted_within(told, 1.0))
        report.share(f"town.prior_{PRIOR_M:g}_m.{depth}.forced_within_1_m", within(told, 1.0))
        wrong = told.localized & ~accepted_within(told, 1.0)
        report.share(f"town.prior_{PRIOR_M:g}_m.{depth}.wrong_and_accepted", wrong, better="lower")
        report.write()
    together = runs.predictions(opened, dataset, "sequence5_stereo", frames_each=FRAMES)
    report.share("town.sequence5.stereo.within_1_m", accepted_within(together, 1.0), bar=0.995)
    report.share("town.sequence5.stereo.forced_within_1_m", within(together, 1.0))
