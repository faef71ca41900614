"""``make evaluate``: retrieval by the stock encoder, by one trained on the paper's city, and by the raw range image.

Everything is simulated, built and measured here from seeds that no training uses (``model_training.training.recipe``). What is
finished is kept under ``--work`` and reused, so an interrupted run goes on.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.kitti_retrieval import retrieve
from benchmarks.report import ROOT, Report
from model_training.baselines.raw_range import raw_best_views
from model_training.cli.progress import bars
from model_training.datasets.dataset import Dataset
from model_training.evaluation.error_measures import wilson_interval
from model_training.evaluation.evaluate import evaluate
from model_training.evaluation.measures import recall_at
from model_training.mapping.build import BuildSettings, build_map
from model_training.simulation.plan import QueryPlan, SimulationPlan
from model_training.simulation.simulate import simulate
from model_training.stock import ENCODER
from model_training.training.recipe import EVALUATION_SEEDS
from service.localization.encoder import Encoder
from service.maps.reader import MapBundle

BOTH = ("precise", "stereo")
RAW_EVERY = 3  # each third query of a set is asked of the raw image too: it is slow, and so many tell 0.3 from 0.4


def paper_plan() -> SimulationPlan:
    """The paper's city: five other drives with Table I's counts, and frames of the survey's own drive."""
    drives = tuple(QueryPlan(name=f"drive{k}", traversal=k, per_class=True, depths=BOTH) for k in range(1, 6))
    own = QueryPlan(name="survey_drive", traversal=0, count=500, on_track=True, depths=("precise",))
    return SimulationPlan(name="paper-city", city="paper", seed=0, queries=(*drives, own))


def unseen_plan(index: int) -> SimulationPlan:
    """One of three cities that no encoder was trained on: 1,000 queries together, and as many blocked ones."""
    count = (334, 333, 333)[index]
    queries = (
        QueryPlan(name="drive1", traversal=1, count=count, depths=BOTH),
        QueryPlan(name="blocked25", traversal=2, count=count, depths=("precise",), blocked=0.25),
    )
    return SimulationPlan(name=f"unseen-{index + 1}", seed=EVALUATION_SEEDS[index + 1], queries=queries)


class Runs:
    """Datasets, maps and figures under one folder, made once."""

    def __init__(self, work: Path) -> None:
        self.work = work

    def dataset(self, plan: SimulationPlan) -> Dataset:
        """Simulate a plan, or take it as it is."""
        folder = self.work / plan.name
        with bars() as report:
            simulate(plan, folder, report=report)
        return Dataset(folder)

    def bundle(self, dataset: Dataset, encoder: Path) -> MapBundle:
        """Build a map with an encoder, or take the one that this encoder made."""
        folder = self.work / "maps" / f"{dataset.name}-{Encoder.open(encoder).sha256[:12]}"
        if not folder.exists():
            folder.parent.mkdir(parents=True, exist_ok=True)
            with bars() as report:
                build_map(dataset, encoder, folder, BuildSettings(name=dataset.name), report=report)
        return MapBundle.open(folder)

    def figures(self, bundle: MapBundle, dataset: Dataset, names: list[str]) -> dict[str, Any]:
        """Evaluate query sets; the answers lie beside for later measures."""
        with bars() as report:
            result = evaluate(bundle, dataset, names, report=report)
        folder = self.work / "predictions" / bundle.path.name
        folder.mkdir(parents=True, exist_ok=True)
        for name, predictions in result.predictions.items():
            predictions.save(folder / f"{name}.npz")
        (folder / f"{'+'.join(names)[:80]}.json").write_text(json.dumps(result.figures, indent=1))
        return result.figures | {"predictions": result.predictions}

    def raw(self, bundle: MapBundle, dataset: Dataset, name: str) -> dict[str, tuple[int, int]]:
        """The raw range image: right ones and number of queries by setting, over each third query of a set."""
        kept = self.work / "raw" / f"{dataset.name}-{name}-every{RAW_EVERY}.json"
        if not kept.exists():
            kept.parent.mkdir(parents=True, exist_ok=True)
            with bars() as report:
                best = raw_best_views(bundle, dataset, [name], every=RAW_EVERY, report=report)
            truth = [f.T_map_camera[:2, 3] for f in dataset.queries(name) if f.T_map_camera is not None][::RAW_EVERY]
            xy = bundle.T_map_place[:, :2, 3]
            counts = {}
            for setting, place in best.items():
                right = recall_at(xy[place][:, None], np.array(truth), 1) & (place >= 0)
                counts[setting] = (int(right.sum()), len(truth))
            kept.write_text(json.dumps(counts))
        return {setting: (right, count) for setting, (right, count) in json.loads(kept.read_text()).items()}


def pooled(parts: list[dict[str, Any]], key: str) -> tuple[float, int, list[float]]:
    """A share over several cities: value, count, Wilson interval."""
    of = "street_queries" if key == "street_accuracy" else "queries"
    count = sum(part[of] for part in parts)
    right = round(sum(part[key] * part[of] for part in parts))
    return right / count, count, list(wilson_interval(right, count))


def share(
    report: Report, row_id: str, figures: dict[str, Any] | list[dict[str, Any]], key: str, bar: float | None = None
) -> None:
    """A row of one share, over one or several evaluations."""
    value, count, interval = pooled(figures if isinstance(figures, list) else [figures], key)
    report.row(row_id, value, "share", bar=bar, n=count, ci95=interval)


def paper_rows(report: Report, runs: Runs, encoder: Path, prefix: str, *, barred: bool) -> None:
    """The paper's city with one encoder."""
    dataset = runs.dataset(paper_plan())
    bundle = runs.bundle(dataset, encoder)
    bars_of = {"precise": (0.9752, 0.98, 0.998), "stereo": (0.95, 0.95, None)}
    for preset in BOTH:
        figures = runs.figures(bundle, dataset, [f"drive{k}_{preset}" for k in range(1, 6)])
        row, (street, first, tenth) = f"{prefix}.paper_city.{preset}", bars_of[preset]
        share(report, f"{row}.street_accuracy", figures, "street_accuracy", street if barred else None)
        share(report, f"{row}.recall_at_1_5m", figures, "recall_at_1_5m", first if barred else None)
        share(report, f"{row}.recall_at_10_5m", figures, "recall_at_10_5m", tenth if barred else None)
        for key in ("mean_distance_error_m", "median_distance_error_m"):
            report.row(f"{row}.{key}", figures[key], "m", n=figures["queries"])
        report.row(f"{row}.median_heading_error_deg", figures["median_heading_error_deg"], "deg", n=figures["queries"])
    own = runs.figures(bundle, dataset, ["survey_drive_precise"])
    share(report, f"{prefix}.paper_city.same_drive.street_accuracy", own, "street_accuracy")
    share(report, f"{prefix}.paper_city.same_drive.recall_at_1_5m", own, "recall_at_1_5m")


def unseen_rows(report: Report, runs: Runs, encoder: Path) -> None:
    """Three unseen cities with the stock encoder, clear and blocked, and the raw image beside."""
    found: dict[str, list[dict[str, Any]]] = {"drive1_precise": [], "drive1_stereo": [], "blocked25_precise": []}
    raw: dict[str, list[dict[str, tuple[int, int]]]] = {name: [] for name in found}
    for index in range(3):
        dataset = runs.dataset(unseen_plan(index))
        bundle = runs.bundle(dataset, encoder)
        for name, parts in found.items():
            parts.append(runs.figures(bundle, dataset, [name]))
            raw[name].append(runs.raw(bundle, dataset, name))
    labels = {
        "drive1_precise": ("precise", 0.985),
        "drive1_stereo": ("stereo", 0.95),
        "blocked25_precise": ("precise_blocked_25", 0.90),
    }
    for name, (label, bar) in labels.items():
        share(report, f"retrieval.unseen.{label}.recall_at_1_5m", found[name], "recall_at_1_5m", bar)
        for key in ("recall_at_5_5m", "recall_at_10_5m", "street_accuracy", "within_1_m"):
            share(report, f"retrieval.unseen.{label}.{key}", found[name], key)
        raw_row(report, f"raw.unseen.{label}.recall_at_1_5m", raw[name], 0.40 if label == "precise" else None)


def raw_row(report: Report, row_id: str, parts: list[dict[str, tuple[int, int]]], bar: float | None) -> None:
    """The raw range image's recall at its best setting over all parts."""
    totals = {s: (sum(p[s][0] for p in parts), sum(p[s][1] for p in parts)) for s in parts[0]}
    best = max(totals, key=lambda s: totals[s][0])
    right, count = totals[best]
    report.row(
        row_id,
        right / count,
        "share",
        bar=bar,
        better="lower",
        n=count,
        ci95=list(wilson_interval(right, count)),
        why=f"best setting: {best}",
    )


def kitti_rows(report: Report, runs: Runs, encoder: Path, data: Path) -> None:
    """Real stereo frames; the rows stay, with a reason, where the recordings are not there."""
    kitti, drive = data / "kitti_stereo", data / "kitti_drive"
    if not (kitti.exists() and drive.exists()):
        for name in ("real", "raw"):
            report.row(
                f"{name}.kitti_stereo.recall_at_1",
                None,
                "share",
                bar=0.97 if name == "real" else None,
                why=f"no recordings at {data.name}",
            )
        return
    found = retrieve(Encoder.open(encoder), kitti, drive, runs.work)
    count = int(found["n"])
    for row_id, value, bar in (
        ("real.kitti_stereo.recall_at_1", found["recall_at_1"], 0.97), ("real.kitti_stereo.recall_at_5", found["recall_at_5"], None),
    ):  # fmt: skip
        report.row(row_id, value, "share", bar=bar, n=count, ci95=list(wilson_interval(round(value * count), count)))
    best = max((k for k in found if k.startswith("raw_")), key=lambda k: found[k])
    report.row("raw.kitti_stereo.recall_at_1", found[best], "share", n=count, why=f"best setting: {best[4:]}")


def main() -> None:
    """Parse, run all parts, write the report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--work", type=Path, default=ROOT / "data" / "evaluate", help="where datasets and maps are kept"
    )
    parser.add_argument("--encoder", type=Path, default=ENCODER)
    parser.add_argument(
        "--paper-encoder",
        type=Path,
        default=ROOT / "runs" / "paper" / "encoder.onnx",
        help="one trained on the paper's city",
    )
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data", help="real recordings")
    arguments = parser.parse_args()
    report, runs = Report("accuracy", "make evaluate"), Runs(arguments.work)
    kitti_rows(report, runs, arguments.encoder, arguments.data)
    unseen_rows(report, runs, arguments.encoder)
    paper_rows(report, runs, arguments.encoder, "retrieval", barred=True)
    paper = runs.dataset(paper_plan())
    for preset in BOTH:
        raw_row(
            report,
            f"raw.paper_city.{preset}.recall_at_1_5m",
            [runs.raw(runs.bundle(paper, arguments.encoder), paper, f"drive1_{preset}")],
            None,
        )
    if arguments.paper_encoder.exists():
        paper_rows(report, runs, arguments.paper_encoder, "trained_on_paper_city", barred=False)
    else:
        report.row(
            "trained_on_paper_city.paper_city.precise.street_accuracy",
            None,
            "share",
            why="no encoder at --paper-encoder: make paper-encoder",
        )
    print(f"written: {report.write()}")


if __name__ == "__main__":
    main()
