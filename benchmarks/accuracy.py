"""``make evaluate``: measure accuracy on simulated cities and real frames -> reports/accuracy.json.

The parts cover retrieval by the stock encoder, retrieval by an encoder trained on the paper's city, the raw range
image, and registration. The command simulates the cities from seeds that no training uses
(``model_training.training.recipe``). It keeps finished work under ``--work`` and reuses it. An interrupted run
therefore continues.
"""

import argparse
from collections.abc import Callable
from pathlib import Path

from benchmarks.conditions import condition_rows
from benchmarks.doubt import doubt_rows
from benchmarks.full import full_paper_rows, full_unseen_rows
from benchmarks.ground import ground_rows
from benchmarks.heights import height_rows
from benchmarks.kitti_registration import kitti_registration_rows
from benchmarks.kitti_retrieval import retrieve
from benchmarks.plans import BOTH, large_plan, paper_plan, unseen_plan
from benchmarks.priors import prior_rows
from benchmarks.raw import raw_condition_rows, raw_paper_rows, raw_rows, raw_unseen_rows
from benchmarks.report import ROOT, Report
from benchmarks.rig_calibration import rig_calibration_rows
from benchmarks.rigs import rig_rows
from benchmarks.runs import Runs, share
from benchmarks.sequences import sequence_rows
from benchmarks.speed import speed_rows
from benchmarks.surveys import survey_rows
from benchmarks.tracks import track_rows
from benchmarks.weather import weather_rows
from model_training.evaluation.error_measures import wilson_interval
from model_training.simulation.plan import SimulationPlan
from model_training.stock import ENCODER
from service.retrieval.encoder import Encoder

#: Query sets of the unseen cities: the label of their rows, and the bar of R@1.
UNSEEN = {
    "drive1_precise": ("precise", 0.985),
    "drive1_stereo": ("stereo", 0.95),
    "blocked25_precise": ("precise_blocked_25", 0.90),
}


def paper_rows(report: Report, runs: Runs, prefix: str, *, barred: bool) -> None:
    """Add the rows of the paper's city with one encoder.

    Args:
        report: collects the rows.
        runs: simulates, builds and answers, or reuses what is kept on disk.
        prefix: first part of the row ids.
        barred: whether the rows have bars.
    """
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


def unseen_rows(report: Report, runs: Runs) -> None:
    """Add the retrieval rows of three unseen cities with the stock encoder, clear and blocked.

    Args:
        report: collects the rows.
        runs: simulates, builds and answers, or reuses what is kept on disk.
    """
    _retrieval_rows(report, runs, "unseen", unseen_plan, barred=True)


def large_rows(report: Report, runs: Runs) -> None:
    """Add the rows of cities of twice the size: retrieval, registration and the raw image, each for the same queries.

    Args:
        report: collects the rows.
        runs: simulates, builds and answers, or reuses what is kept on disk.
    """
    _retrieval_rows(report, runs, "large", large_plan, barred=False)
    for preset in BOTH:
        datasets = [runs.dataset(large_plan(index)) for index in range(3)]
        found = [runs.figures(runs.bundle(each), each, [f"drive1_{preset}"], refine=True) for each in datasets]
        for key in ("within_0_5_m", "within_1_m", "localized"):
            share(report, f"full.large.{preset}.{key}", found, key)
    raw_rows(report, runs, "large", large_plan)


def _retrieval_rows(
    report: Report, runs: Runs, cities: str, plan_of: Callable[[int], SimulationPlan], *, barred: bool
) -> None:
    for name, (label, bar) in UNSEEN.items():
        found = []
        for index in range(3):
            dataset = runs.dataset(plan_of(index))
            found.append(runs.figures(runs.bundle(dataset), dataset, [name]))
        row = f"retrieval.{cities}.{label}"
        share(report, f"{row}.recall_at_1_5m", found, "recall_at_1_5m", bar if barred else None)
        for key in ("recall_at_5_5m", "recall_at_10_5m", "street_accuracy", "within_1_m"):
            share(report, f"{row}.{key}", found, key)


def kitti_rows(report: Report, runs: Runs, data: Path) -> None:
    """Add the rows of real stereo frames; without recordings, each row gives the reason.

    Args:
        report: collects the rows.
        runs: simulates, builds and answers, or reuses what is kept on disk.
        data: folder with the recordings ``kitti_stereo`` and ``kitti_drive``.
    """
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
        ("real.kitti_stereo.recall_at_1", found["recall_at_1"], 0.97),
        ("real.kitti_stereo.recall_at_5", found["recall_at_5"], None),
    ):
        report.row(row_id, value, "share", bar=bar, n=count, ci95=list(wilson_interval(round(value * count), count)))
    best = max((k for k in found if k.startswith("raw_")), key=lambda k: found[k])
    report.row("raw.kitti_stereo.recall_at_1", found[best], "share", n=count, why=f"best setting: {best[4:]}")


def trained_there_rows(report: Report, work: Path, encoder: Path) -> None:
    """Add the rows of an encoder that was trained on the paper's city.

    Args:
        report: collects the rows.
        work: folder for datasets and maps.
        encoder: file of that encoder; it may be absent.
    """
    if encoder.exists():
        paper_rows(report, Runs(work, encoder), "trained_on_paper_city", barred=False)
        return
    why = "no encoder at --paper-encoder: make paper-encoder"
    report.row("trained_on_paper_city.paper_city.precise.street_accuracy", None, "share", why=why)


def main() -> None:
    """Parse the arguments, run the parts and write the report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=ROOT / "data" / "evaluate", help="folder of datasets and maps")
    parser.add_argument("--encoder", type=Path, default=ENCODER, help="encoder; default: the stock encoder")
    parser.add_argument(
        "--paper-encoder",
        type=Path,
        default=ROOT / "runs" / "paper" / "encoder.onnx",
        help="encoder trained on the paper's city",
    )
    parser.add_argument(
        "--data", type=Path, default=ROOT.parent / "shared" / "data", help="folder of the real recordings"
    )
    parser.add_argument(
        "--calibration-work",
        type=Path,
        default=ROOT / "data" / "calibration",
        help="folder of `streetfix calibrate` (part rigs)",
    )
    parser.add_argument("--note", help="remark on this run for readers of the report")
    parser.add_argument(
        "--only", help="parts to run, separated by commas; the rows of the others stay, each with the run that made it"
    )
    arguments = parser.parse_args()
    told = "" if arguments.only is None else f' ARGS="--only {arguments.only}"'
    report, runs = Report("accuracy", f"make evaluate{told}"), Runs(arguments.work, arguments.encoder)
    parts: dict[str, Callable[[], None]] = {
        "kitti": lambda: kitti_rows(report, runs, arguments.data),
        "kitti_registration": lambda: kitti_registration_rows(report, runs, arguments.data),
        "full_unseen": lambda: full_unseen_rows(report, runs),
        "full_paper": lambda: full_paper_rows(report, runs),
        "speed": lambda: speed_rows(report, runs),
        "doubt": lambda: doubt_rows(report, runs),
        "conditions": lambda: condition_rows(report, runs),
        "sequences": lambda: sequence_rows(report, runs),
        "tracks": lambda: track_rows(report, runs),
        "priors": lambda: prior_rows(report, runs),
        "heights": lambda: height_rows(report, runs),
        "ground": lambda: ground_rows(report, runs),
        "surveys": lambda: survey_rows(report, runs),
        "rigs": lambda: rig_rows(report, arguments.encoder, arguments.calibration_work),
        "rig_calibration": lambda: rig_calibration_rows(report, runs),
        "unseen": lambda: unseen_rows(report, runs),
        "large": lambda: large_rows(report, runs),
        "paper": lambda: paper_rows(report, runs, "retrieval", barred=True),
        "weather": lambda: weather_rows(report, runs),
        "raw_unseen": lambda: raw_unseen_rows(report, runs),
        "raw_paper": lambda: raw_paper_rows(report, runs),
        "raw_conditions": lambda: raw_condition_rows(report, runs),
        "trained_there": lambda: trained_there_rows(report, arguments.work, arguments.paper_encoder),
    }
    wanted = list(parts) if arguments.only is None else arguments.only.split(",")
    if unknown := sorted(set(wanted) - set(parts)):
        parser.error(f"--only: unknown part {unknown[0]!r}; choose from: {', '.join(parts)}")
    if arguments.only is not None:
        report.keep_others()
    if arguments.note or arguments.only is not None:  # an earlier note does not describe this run
        report.notes["run"] = arguments.note
    for name in wanted:
        print(f"--- {name}", flush=True)
        parts[name]()
        report.write()  # write after each part: a failure later costs only the later parts


if __name__ == "__main__":
    main()
