"""The full answer: registration after retrieval, with position, heading and covariance."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.coverage import COVERAGE_BAR, SIGMA_GAP_BAR, consistent, sigma_gaps
from benchmarks.plans import BOTH, more_plan, paper_plan, unseen_plan
from benchmarks.report import Report
from benchmarks.runs import Runs, share
from model_training.calibration.bounds import WRONG_RATE
from model_training.evaluation.error_measures import distance_errors, heading_errors_deg
from model_training.evaluation.measures import measure
from model_training.evaluation.pose_errors import pose_errors
from model_training.evaluation.predict import Predictions, headings_of, joined
from service.geometry.rigid import heading_of_camera


def full_paper_rows(report: Report, runs: Runs) -> None:
    """Add the rows of the paper's city: five other traversals with Table I's counts.

    Args:
        report: collects the rows.
        runs: simulates, builds and answers, or reuses what is kept on disk.
    """
    dataset = runs.dataset(paper_plan())
    bundle = runs.bundle(dataset)
    for preset, street in (("precise", 0.998), ("stereo", 0.985)):
        figures = runs.figures(bundle, dataset, [f"drive{k}_{preset}" for k in range(1, 6)], refine=True)
        row, precise = f"full.paper_city.{preset}", preset == "precise"
        share(report, f"{row}.street_accuracy", figures, "street_accuracy", street)
        share(report, f"{row}.localized", figures, "localized", 0.99 if precise else None)
        share(report, f"{row}.within_1_m", figures, "within_1_m")
        report.row(f"{row}.forced_within_1_m", figures["forced"]["within_1_m"], "share", n=figures["queries"])
        forced = {f"forced_{key}": value for key, value in figures["forced"].items()}
        bars = {"mean_distance_error_m": 0.05, "median_distance_error_m": 0.04, "forced_mean_distance_error_m": 0.15}
        for key, bar in bars.items():
            value = (figures | forced)[key]
            report.row(f"{row}.{key}", value, "m", bar=bar if precise else None, better="lower", n=figures["queries"])


def unseen_answers(runs: Runs, preset: str) -> list[Predictions]:
    """Answer 1,000 queries of each of the three unseen cities by their own maps.

    Args:
        runs: simulates, builds and answers, or reuses what is kept on disk.
        preset: depth preset.
    """
    found = []
    for index in range(3):
        dataset, more = runs.dataset(unseen_plan(index)), runs.dataset(more_plan(index))
        bundle = runs.bundle(dataset)
        first = runs.figures(bundle, dataset, [f"drive1_{preset}"], refine=True)["predictions"]
        second = runs.figures(bundle, more, [f"drive3_{preset}"], refine=True)["predictions"]
        found.append(joined([*first.values(), *second.values()]))
    return found


def full_unseen_rows(report: Report, runs: Runs) -> None:
    """Add the rows of three unseen cities: shares over all queries, medians over accepted answers.

    Args:
        report: collects the rows.
        runs: simulates, builds and answers, or reuses what is kept on disk.
    """
    headings = {"precise": 0.12, "stereo": 0.35}
    coverage: dict[str, float] = {}
    gaps: dict[str, float] = {}
    for preset in BOTH:
        cities = unseen_answers(runs, preset)
        parts: list[dict[str, Any]] = [measure(each, _numbered(each)) for each in cities]
        row = f"full.unseen.{preset}"
        share(report, f"{row}.within_0_5_m", parts, "within_0_5_m", 0.998 if preset == "precise" else None)
        share(report, f"{row}.within_1_m", parts, "within_1_m", 0.985 if preset == "stereo" else None)
        share(report, f"{row}.localized", parts, "localized")
        answers = joined(cities)
        accepted = answers.localized
        distance = distance_errors(answers.T_answer[:, :2, 3], answers.T_true[:, :2, 3])
        forced = np.nan_to_num(distance, nan=np.inf)
        report.row(f"{row}.forced_within_1_m", float((forced <= 1.0).mean()), "share", n=len(forced))
        turned = heading_errors_deg(headings_of(answers.T_answer), headings_of(answers.T_true))
        bar = 0.10 if preset == "stereo" else None
        count, none = int(accepted.sum()), None if accepted.any() else "no LOCALIZED answer"
        middle = float(np.median(distance[accepted])) if count else None
        report.row(f"{row}.median_distance_error_m", middle, "m", bar=bar, better="lower", n=count, why=none)
        middle = float(np.median(turned[accepted])) if count else None
        report.row(
            f"{row}.median_heading_error_deg", middle, "deg", bar=headings[preset], better="lower", n=count, why=none
        )
        near = accepted & (np.linalg.norm(answers.T_answer[:, :3, 3] - answers.T_true[:, :3, 3], axis=1) < 1.0)
        errors, covariances = pose_errors(answers.T_answer[near], answers.T_true[near]), answers.covariance[near]
        for name, size in (("position", 3), ("full_pose", 6)):
            coverage[f"{name}.{preset}"] = consistent(errors[:, :size], covariances[:, :size, :size])
        towards = np.array([heading_of_camera(T) for T in answers.T_true[near]])
        gaps |= {f"{axis}.{preset}": gap for axis, gap in sigma_gaps(towards, errors, covariances).items()}
        gross_error_row(report, preset, accepted, near)
    for name, value in coverage.items():
        report.row(f"doubt.covariance_95_coverage.{name}", value, "share")
    worst = max(coverage.values(), key=lambda value: abs(value - np.mean(COVERAGE_BAR)))
    report.row("doubt.covariance_95_coverage", worst, "share", bar=COVERAGE_BAR, why="the worst of the four above")
    for name, value in gaps.items():
        report.row(f"doubt.sigma_coverage_gap.{name}", value, "share", better="lower")
    report.row(
        "doubt.sigma_coverage_gap",
        max(gaps.values()),
        "share",
        bar=SIGMA_GAP_BAR,
        better="lower",
        why="the worst of those above",
    )


def gross_error_row(report: Report, preset: str, accepted: NDArray[np.bool_], near: NDArray[np.bool_]) -> None:
    """Add the share of LOCALIZED answers that are more than 1 m off: what the safe default promises.

    Args:
        report: collects the rows.
        preset: depth preset.
        accepted: whether each answer is LOCALIZED (n,).
        near: whether each answer is LOCALIZED and within 1 m (n,).
    """
    report.share(f"doubt.gross_errors.{preset}", ~near[accepted], bar=WRONG_RATE, better="lower")


def _numbered(answers: Predictions) -> list[str]:
    """Return placeholder names for the streets; they are not shown."""
    return [str(number) for number in range(1 + int(max(answers.street_true.max(), answers.street_answer.max())))]
