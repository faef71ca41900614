"""The raw range image, a method without learning, in the same cities, traversals and conditions, as a reference."""

from collections.abc import Callable, Iterable

from benchmarks.conditions import asked_of
from benchmarks.plans import BOTH, paper_plan, unseen_plan
from benchmarks.report import Report
from benchmarks.runs import Runs
from model_training.evaluation.error_measures import wilson_interval
from model_training.evaluation.raw_range import STRAIGHT
from model_training.simulation.plan import SimulationPlan

#: Query sets of the unseen cities: the label of their rows.
UNSEEN = {"drive1_precise": "precise", "drive1_stereo": "stereo", "blocked25_precise": "precise_blocked_25"}
#: Recall above which a city is too easy to be a useful test.
TOO_EASY = 0.40


def raw_unseen_rows(report: Report, runs: Runs) -> None:
    """Add the rows of the unseen cities.

    Args:
        report: collects the rows.
        runs: simulates, builds and answers, or reuses what is kept on disk.
    """
    raw_rows(report, runs, "unseen", unseen_plan, TOO_EASY)


def raw_rows(
    report: Report, runs: Runs, cities: str, plan_of: Callable[[int], SimulationPlan], bar: float | None = None
) -> None:
    """Add the rows of three cities, also for queries without turns, as of a single image.

    Args:
        report: collects the rows.
        runs: simulates, builds and answers, or reuses what is kept on disk.
        cities: name of the cities in row ids.
        plan_of: plan of a city by its number.
        bar: largest recall with the precise preset; None for no bar.
    """
    for name, label in UNSEEN.items():
        parts = []
        for index in range(3):
            dataset = runs.dataset(plan_of(index))
            parts.append(runs.raw(runs.bundle(dataset), dataset, name))
        _row(report, f"raw.{cities}.{label}.recall_at_1_5m", parts, bar if label == "precise" else None)
        straight = [{name: found for name, found in part.items() if name.endswith(STRAIGHT)} for part in parts]
        _row(report, f"raw.{cities}.{label}.straight.recall_at_1_5m", straight)


def raw_paper_rows(report: Report, runs: Runs) -> None:
    """Add the rows of the paper's city: another traversal and the survey's own.

    Args:
        report: collects the rows.
        runs: simulates, builds and answers, or reuses what is kept on disk.
    """
    paper = runs.dataset(paper_plan())
    sets = {preset: f"drive1_{preset}" for preset in BOTH} | {"same_drive": "survey_drive_precise"}
    for label, name in sets.items():
        _row(report, f"raw.paper_city.{label}.recall_at_1_5m", [runs.raw(runs.bundle(paper), paper, name)])


def raw_condition_rows(report: Report, runs: Runs) -> None:
    """Add the rows of every hard condition.

    Args:
        report: collects the rows.
        runs: simulates, builds and answers, or reuses what is kept on disk.
    """
    for condition, bundle, dataset, name in asked_of(runs):
        _row(report, f"raw.condition.{condition}.recall_at_1_5m", [runs.raw(bundle, dataset, name)])


def _row(report: Report, row_id: str, parts: Iterable[dict[str, tuple[int, int]]], bar: float | None = None) -> None:
    """Add the recall of the best setting over all parts."""
    each = list(parts)
    totals = {setting: tuple(sum(part[setting][k] for part in each) for k in (0, 1)) for setting in each[0]}
    best = max(totals, key=lambda setting: totals[setting][0])
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
