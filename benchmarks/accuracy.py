"""``make evaluate``: retrieval by the stock encoder and by one trained on the paper's city, the raw image, registration.

Everything is simulated, built and measured here from seeds that no training uses (``model_training.training.recipe``). What is
finished is kept under ``--work`` and reused, so an interrupted run goes on.
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.kitti_retrieval import retrieve
from benchmarks.report import ROOT, Report
from benchmarks.runs import Runs, share
from benchmarks.weather import weather_rows
from model_training.evaluation.error_measures import distance_errors, heading_errors_deg, wilson_interval
from model_training.evaluation.predict import headings_of, joined
from model_training.simulation.plan import QueryPlan, SimulationPlan
from model_training.stock import ENCODER
from model_training.training.recipe import EVALUATION_SEEDS
from service.localization.encoder import Encoder

BOTH = ("precise", "stereo")


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


def paper_rows(report: Report, runs: Runs, prefix: str, *, barred: bool) -> None:
    """The paper's city with one encoder."""
    dataset = runs.dataset(paper_plan())
    bundle = runs.bundle(dataset)
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


def full_paper_rows(report: Report, runs: Runs) -> None:
    """The paper's city with registration."""
    dataset = runs.dataset(paper_plan())
    bundle = runs.bundle(dataset)
    for preset, street in (("precise", 0.998), ("stereo", 0.985)):
        figures = runs.figures(bundle, dataset, [f"drive{k}_{preset}" for k in range(1, 6)], refine=True)
        row, precise = f"full.paper_city.{preset}", preset == "precise"
        share(report, f"{row}.street_accuracy", figures, "street_accuracy", street)
        share(report, f"{row}.localized", figures, "localized", 0.99 if precise else None)
        share(report, f"{row}.within_1_m", figures, "within_1_m")
        forced = {f"forced_{key}": value for key, value in figures["forced"].items()}
        for key, bar in (
            ("mean_distance_error_m", 0.05),
            ("median_distance_error_m", 0.04),
            ("forced_mean_distance_error_m", 0.15),
        ):
            value = (figures | forced)[key]
            report.row(f"{row}.{key}", value, "m", bar=bar if precise else None, better="lower", n=figures["queries"])


def full_unseen_rows(report: Report, runs: Runs) -> None:
    """Three unseen cities with registration: shares over all queries, medians over all that were answered."""
    headings = {"precise": 0.12, "stereo": 0.35}
    for preset in BOTH:
        parts, predictions = [], []
        for index in range(3):
            dataset = runs.dataset(unseen_plan(index))
            figures = runs.figures(runs.bundle(dataset), dataset, [f"drive1_{preset}"], refine=True)
            parts.append(figures)
            predictions += list(figures["predictions"].values())
        row = f"full.unseen.{preset}"
        share(report, f"{row}.within_0_5_m", parts, "within_0_5_m", 0.998 if preset == "precise" else None)
        share(report, f"{row}.within_1_m", parts, "within_1_m", 0.985 if preset == "stereo" else None)
        answers = joined(predictions)
        distance = distance_errors(answers.T_answer[:, :2, 3], answers.T_true[:, :2, 3])
        turned = heading_errors_deg(headings_of(answers.T_answer), headings_of(answers.T_true))
        for key, errors, unit, bar in (
            ("median_distance_error_m", distance, "m", 0.10 if preset == "stereo" else None),
            ("median_heading_error_deg", turned, "deg", headings[preset]),
        ):
            report.row(
                f"{row}.{key}", float(np.nanmedian(errors)), unit, bar=bar, better="lower", n=int(np.isfinite(errors).sum())
            )  # fmt: skip


def unseen_rows(report: Report, runs: Runs) -> None:
    """Three unseen cities with the stock encoder, clear and blocked, and the raw image beside."""
    found: dict[str, list[dict[str, Any]]] = {"drive1_precise": [], "drive1_stereo": [], "blocked25_precise": []}
    raw: dict[str, list[dict[str, tuple[int, int]]]] = {name: [] for name in found}
    for index in range(3):
        dataset = runs.dataset(unseen_plan(index))
        bundle = runs.bundle(dataset)
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


def kitti_rows(report: Report, runs: Runs, data: Path) -> None:
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
    found = retrieve(Encoder.open(runs.encoder), kitti, drive, runs.work)
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
    parser.add_argument("--note", help="what a reader of the report must know about this run")
    arguments = parser.parse_args()
    report, runs = Report("accuracy", "make evaluate"), Runs(arguments.work, arguments.encoder)
    for part in (
        lambda: kitti_rows(report, runs, arguments.data), lambda: unseen_rows(report, runs), lambda: full_unseen_rows(report, runs),
        lambda: paper_rows(report, runs, "retrieval", barred=True), lambda: full_paper_rows(report, runs),
        lambda: weather_rows(report, runs),
    ):  # fmt: skip
        part()
        report.write()  # a defect or a stop in a later part costs that part alone
    paper = runs.dataset(paper_plan())
    for preset in BOTH:
        raw_row(
            report,
            f"raw.paper_city.{preset}.recall_at_1_5m",
            [runs.raw(runs.bundle(paper), paper, f"drive1_{preset}")],
            None,
        )
    if arguments.paper_encoder.exists():
        paper_rows(report, Runs(arguments.work, arguments.paper_encoder), "trained_on_paper_city", barred=False)
    else:
        report.row(
            "trained_on_paper_city.paper_city.precise.street_accuracy",
            None,
            "share",
            why="no encoder at --paper-encoder: make paper-encoder",
        )
    if arguments.note:
        report.notes["run"] = arguments.note
    print(f"written: {report.write()}")


if __name__ == "__main__":
    main()
