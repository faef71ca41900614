"""``make bench-training``: measure training, simulation, demo and tests on this machine -> reports/training.json.

Use an idle machine. The speeds include loading and writing, as in the commands.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import torch
from torch.nn import functional

from benchmarks.loss_curve import loss_gap
from benchmarks.report import ROOT, Report
from model_training.simulation.plan import QueryPlan, SimulationPlan
from model_training.simulation.simulate import simulate
from model_training.training.augment import Augmenter
from model_training.training.batches import City
from model_training.training.encoder_net import EncoderNet, EncoderShape
from model_training.training.loop import Progress, TrainingConfig, train
from model_training.training.losses import Side, paired_info_nce
from model_training.training.packs import Pack, PackPlan, make_packs
from service.imaging.view_grid import ViewGrid

PAPER_FRAMES, PAPER_EPOCHS, PAPER_MINUTES = 46_741, 4, 138
#: Seed of training data that no recipe uses.
BENCH_SEED = 1900
#: Steps of the running mean in which loss curves are also compared. Rounding errors grow, and single steps scatter.
LOSS_WINDOW = 10


def packs_for_bench(work: Path) -> list[Path]:
    """Make two cities of the size of the stock recipe; return their packs.

    Args:
        work: folder of the packs.
    """
    plans = [PackPlan(seed=BENCH_SEED + k) for k in range(2)]
    return make_packs(plans, work / "packs", ViewGrid())


def own_size(report: Report, packs: list[Path], work: Path, steps: int) -> None:
    """Add the speed of the training loop: drawing, augmenting, stepping, logging and saving.

    Args:
        report: collects the rows.
        packs: training packs.
        work: folder of the run.
        steps: training steps.
    """
    seen: list[tuple[float, int]] = []

    def note(progress: Progress) -> None:
        seen.append((time.perf_counter(), progress.step))

    run = work / "bench-run"
    shutil.rmtree(run, ignore_errors=True)
    train(packs, run, TrainingConfig(steps=steps), device="cpu", report=note)
    (began, first), (ended, last) = seen[4], seen[-1]  # the first steps read the packs from disk
    images = (last - first) * 2 * TrainingConfig().pairs / (ended - began)
    minutes = PAPER_FRAMES * PAPER_EPOCHS / images / 60
    report.row("training.images_per_s", images, "1/s", n=last - first)
    report.row(
        "training.minutes_for_paper_images",
        minutes,
        "min",
        bar=10,
        better="lower",
        n=last - first,
        why=f"{PAPER_FRAMES} x {PAPER_EPOCHS} branches of pairs, 32 x 128; the paper: {PAPER_MINUTES} min, 224 x 224",
    )


def paper_size(report: Report, packs: list[Path], steps: int) -> None:
    """Add the speed of the same network and loss at the paper's 224 x 224; views are enlarged after augmentation.

    Args:
        report: collects the rows.
        packs: training packs.
        steps: training steps.
    """
    shape = EncoderShape(rows=224, columns=224)
    net = EncoderNet(shape).to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # torch documents it, its stub does not
    grid, device = ViewGrid(), torch.device("cpu")
    rng, city = np.random.default_rng(0), City(Pack.open(packs[0]), grid, turn_deg=TrainingConfig().turn_deg)
    augment = Augmenter(TrainingConfig().augmentation, grid, torch.Generator().manual_seed(0), device)
    optimiser = torch.optim.AdamW(net.parameters(), lr=1e-3)
    images, began = 0, 0.0
    for step in range(steps + 1):
        if step == 1:
            began = time.perf_counter()
        batch = city.draw(32, rng)
        count = len(batch.query_xy)
        rows = augment.cut_rows(batch.rows_seen, count)
        planes = torch.cat(
            [
                augment.query(batch.query_ranges, batch.query_rgb, batch.query_height_m, rows),
                augment.survey(batch.survey_ranges, batch.survey_intensity, batch.survey_height_m, rows),
            ]
        )
        large = functional.interpolate(planes, size=(224, 224), mode="nearest").contiguous(
            memory_format=torch.channels_last
        )
        descriptors = net(large, torch.cat([torch.ones(count), torch.zeros(count)]))
        sides = Side(descriptors[:count], batch.query_xy), Side(descriptors[count:], batch.survey_xy)
        loss = paired_info_nce(*sides, scale=torch.tensor(20.0))[0].mean()
        optimiser.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]  # torch's own stub leaves it untyped
        optimiser.step()
        images += batch.images if step else 0
    rate = images / (time.perf_counter() - began)
    report.row("training.minutes_for_paper_images_224", PAPER_FRAMES * PAPER_EPOCHS / rate / 60, "min", n=steps)


def two_processes(report: Report, work: Path, steps: int) -> None:
    """Add how far the loss curve of two processes under torchrun is from the curve of one process.

    Two threads instead of one change only the order of sums. Their curve shows what rounding alone does.

    Args:
        report: collects the rows.
        work: folder of packs and runs.
        steps: training steps.
    """
    packs = make_packs([PackPlan(seed=BENCH_SEED, places=300, queries_a_place=1)], work / "packs", ViewGrid())
    config = TrainingConfig(steps=steps, pairs=64, shards=2, memory_after=steps // 3)
    folder = work / "bench-processes"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    (folder / "config.json").write_text(config.model_dump_json())
    torchrun = ("-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m", "--")
    curves = {}
    for name, threads, start in (("one", 1, ("-m",)), ("processes", 1, torchrun), ("threads", 2, ("-m",))):
        out = folder / f"{name}.json"
        options = ["--run", str(folder / name), "--config", str(folder / "config.json"), "--out", str(out), "--packs"]
        command = [sys.executable, *start, "benchmarks.loss_curve", *options, *map(str, packs)]
        subprocess.run(command, check=True, cwd=ROOT, env=os.environ | {"OMP_NUM_THREADS": str(threads)})
        curves[name] = np.array(json.loads(out.read_text()))
    one = curves["one"]
    for row, name, bar in (
        ("train.two_process_loss_gap", "processes", 0.02),
        # Two threads change only the order of sums.
        ("train.rounding_loss_gap", "threads", None),
    ):
        what = f"greatest relative difference of the loss of one step, {name} against one process; hard negatives in the last two thirds"
        report.row(row, loss_gap(one, curves[name]), "share", bar=bar, better="lower", n=steps, why=what)
        mean = loss_gap(one, curves[name], window=LOSS_WINDOW)
        report.row(f"{row}_mean", mean, "share", better="lower", n=steps, why=f"the same, mean of {LOSS_WINDOW} steps")


def simulation(report: Report, work: Path) -> None:
    """Add the rate of frames written to disk: 32 x 1024 scans, and 640 x 480 pairs with JPEG and PNG.

    Args:
        report: collects the rows.
        work: folder of the dataset.
    """
    times: dict[str, list[tuple[float, int]]] = {}

    def note(stage: str, done: int, _total: int) -> None:
        times.setdefault(stage.split()[0], []).append((time.perf_counter(), done))

    folder = work / "bench-simulation"
    shutil.rmtree(folder, ignore_errors=True)
    plan = SimulationPlan(
        name="bench",
        seed=BENCH_SEED,
        size_m=(200.0, 260.0),
        queries=(QueryPlan(name="drive1", traversal=1, count=160),),
    )
    simulate(plan, folder, report=note)
    for stage, row, bar in (("survey", "simulate.scans_per_s", 60), ("queries", "simulate.rgbd_frames_per_s", 8)):
        (began, first), (ended, last) = times[stage][0], times[stage][-1]
        report.row(row, (last - first) / (ended - began), "1/s", bar=bar, n=last - first)
    shutil.rmtree(folder)


#: The two commands of the README: target and arguments, and the longest time in minutes.
WALLS = {"demo": (("demo", "ARGS=--once"), 4), "test": (("test",), 15)}


def walls(report: Report, names: Iterable[str] = WALLS) -> None:
    """Add the times of the README's two commands on a fresh clone; packages come from the cache.

    Args:
        report: collects the rows.
        names: names of the commands, keys of ``WALLS``.
    """
    # A calling make passes its own arguments on, including ours.
    surroundings = {
        name: value for name, value in os.environ.items() if not name.startswith(("MAKE", "MFLAGS", "ARGS"))
    }
    with tempfile.TemporaryDirectory() as folder:
        clone = Path(folder) / "streetfix"
        subprocess.run(["git", "clone", "-q", str(ROOT), str(clone)], check=True)
        for name in names:
            target, bar = WALLS[name]
            subprocess.run(["make", "-s", f"install-{name}"], cwd=clone, check=True, env=surroundings)
            began = time.perf_counter()
            done = subprocess.run(["make", "-s", *target], cwd=clone, check=False, env=surroundings)
            minutes = (time.perf_counter() - began) / 60
            why = None if done.returncode == 0 else f"make {' '.join(target)} ended with {done.returncode}"
            report.row(f"{name}.minutes", minutes if why is None else None, "min", bar=bar, better="lower", why=why)


def main() -> None:
    """Parse the arguments, measure and write the report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=ROOT / "data" / "bench", help="folder of data and runs")
    parser.add_argument("--steps", type=int, default=60, help="optimiser steps to measure")
    part = parser.add_mutually_exclusive_group()
    part.add_argument(
        "--no-walls", action="store_true", help="leave out the demo and the tests, which take longest; their rows stay"
    )
    part.add_argument(
        "--only",
        choices=[*WALLS, "processes"],
        help="measure only this; the other rows stay. demo and test: on a fresh clone. processes: one process against two",
    )
    arguments = parser.parse_args()
    arguments.work.mkdir(parents=True, exist_ok=True)
    told = "--no-walls" if arguments.no_walls else f"--only {arguments.only}" if arguments.only else ""
    report = Report("training", "make bench-training" + (f' ARGS="{told}"' if told else ""))
    if arguments.only:
        report.keep_others()
        if arguments.only == "processes":
            two_processes(report, arguments.work, arguments.steps)
        else:
            walls(report, [arguments.only])
        print(f"written: {report.write()}")
        return
    simulation(report, arguments.work)
    packs = packs_for_bench(arguments.work)
    own_size(report, packs, arguments.work, arguments.steps)
    paper_size(report, packs, 4)
    two_processes(report, arguments.work, arguments.steps)
    if arguments.no_walls:
        report.keep_others()
    else:
        walls(report)
    print(f"written: {report.write()}")


if __name__ == "__main__":
    main()
