"""Rows of the comparison, and the bars of our method."""

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from benchmarks.paper.kept import SPLITS, MethodResult
from benchmarks.paper.pace import Pace
from benchmarks.report import Report
from model_training.evaluation.error_measures import (
    distance_errors,
    mean_error_distance,
    mean_squared_error,
    wilson_interval,
)
from research.baselines.answers import PlaceAnswers
from research.baselines.paper.knn import PAPER_K
from research.baselines.paper_data.pairs import Pairs
from research.baselines.regression.locate import STAGES

#: Number of images that the paper's 84 iterations show: four times 70 % of its frames.
PAPER_IMAGES = round(4 * 0.7 * 46_741)
METHODS = (
    "streetfix",
    "cnn_knn",
    "cnn_softmax",
    "icp_pointnetlk_googlenet",
    "scan_context",
    "raw_range",
    "dual_encoder",
    "fov_encoder",
)
#: Our methods that are trained on the comparison's data. They must lead.
TRAINED_BY_US = ("streetfix", "streetfix_as_paper")
#: Methods whose training has another name in ``Pace``.
PACED_AS = {"streetfix_as_paper": "streetfix"} | dict.fromkeys(STAGES, "googlenet")
METRICS = (("street_accuracy", "share"), ("mean_distance_error_m", "m"), ("mse_m2", "m2"), ("training_minutes", "min"))


def errors_of(answers: PlaceAnswers, test: Pairs) -> NDArray[np.float64]:
    """Return position errors (n,), metres; a query without an answer gets the mean position of all queries.

    Args:
        answers: answers of a method.
        test: test queries with ground truth.
    """
    truth = np.asarray(test.T_map_camera)[:, :2, 3]
    xy = np.where(np.isfinite(answers.xy), answers.xy, truth.mean(axis=0))
    return distance_errors(xy, truth)


def figures_of(answers: PlaceAnswers, test: Pairs) -> dict[str, float]:
    """Return the comparison's figures of one method on one split.

    Args:
        answers: answers of the method.
        test: test queries with ground truth.
    """
    errors = errors_of(answers, test)
    return {
        "street_accuracy": float((answers.street == np.asarray(test.street)).mean()),
        "mean_distance_error_m": mean_error_distance(errors),
        "median_distance_error_m": float(np.median(errors)),
        "mse_m2": mean_squared_error(errors),
        "within_1_m": float((errors <= 1.0).mean()),
    }


def minutes_for_paper_images(method: str, result: MethodResult, pace: Pace | None) -> float | None:
    """Return processor minutes of training for the number of images of the paper's iterations; None without learning.

    The measured pace has priority. Otherwise the time is scaled from the method's own training.

    Args:
        method: name of the method.
        result: result of the method.
        pace: measured training pace; None if absent.
    """
    if not result.images or result.training_s is None:
        return None
    measured = _paced_minutes(method, result, pace)
    return result.training_s / 60 * PAPER_IMAGES / result.images if measured is None else measured


def _paced_minutes(method: str, result: MethodResult, pace: Pace | None) -> float | None:
    """Return the minutes by measured pace; a variant of the paper's network has its own pace."""
    variant = result.method.removeprefix("cnn_knn_").removeprefix("cnn_softmax_")
    paced = PACED_AS.get(method, method) if variant == result.method else f"cnn_{variant}"
    return None if pace is None else pace.minutes(paced, PAPER_IMAGES)


def _quickest_other(results: Mapping[str, MethodResult], pace: Pace | None) -> float | None:
    """Return the minutes of the quickest learned method other than ours, by measured pace or else by own training."""
    if pace is None:
        found = [
            minutes_for_paper_images(name, result, None)
            for name, result in results.items()
            if not name.startswith("streetfix")
        ]
    else:
        found = [pace.minutes(name, PAPER_IMAGES) for name in pace.seconds_an_image if not name.startswith("streetfix")]
    return min((minutes for minutes in found if minutes is not None), default=None)


def all_rows(
    report: Report,
    results: Mapping[str, MethodResult],
    tests: Mapping[str, Pairs],
    missing: Mapping[str, str],
    pace: Pace | None = None,
) -> dict[str, dict[str, dict[str, float]]]:
    """Add every method's rows, ours with bars from the best other method; return figures by method and split.

    Args:
        report: collects the rows.
        results: results by method.
        tests: test queries by split.
        missing: reason for an absent method, by name.
        pace: measured training pace; None if absent.
    """
    found = {
        method: {split: figures_of(result.answers[split], tests[split]) for split in SPLITS}
        for method, result in results.items()
    }
    for method in [*METHODS, *(name for name in results if name not in METHODS)]:
        for split in SPLITS:
            if method not in results:
                for key, unit in METRICS:
                    report.row(f"paper.{method}.{split}.{key}", None, unit, why=missing[method])
                continue
            with report.made_by(results[method].run):
                _rows_of(report, method, split, results[method], found, len(tests[split]))
        if method in results and (minutes := minutes_for_paper_images(method, results[method], pace)) is not None:
            bar = _quickest_other(results, pace) if method in TRAINED_BY_US else None
            in_turn = pace is not None and _paced_minutes(method, results[method], pace) is not None
            how = "by steps of all methods in turn in one run" if in_turn else "scaled from its own run"
            with report.made_by(pace.run if pace is not None and in_turn else results[method].run):
                report.row(
                    f"paper.{method}.minutes_for_paper_images",
                    minutes,
                    "min",
                    bar=bar,
                    better="lower",
                    n=PAPER_IMAGES,
                    why=f"processor minutes, {how}" + ("; bar: the quickest other learned method's" if bar else ""),
                )
    for method, result in results.items():
        if method.startswith("cnn_knn_"):
            with report.made_by(result.run):
                _rows_of_other_pictures(report, method.removeprefix("cnn_knn_"), result)
    return found


def _rows_of_other_pictures(report: Report, variant: str, result: MethodResult) -> None:
    """Add a variant's figures for queries other than RGB-D: LiDAR frames (also by the paper's split) and depth alone."""
    for key in ("lidar.same_drive", "lidar.other_drive", "depth.same_drive", "depth.other_drive"):
        asked = result.extra["asked"][key]
        for method, (accuracy, mean_m) in (("cnn_knn", asked["knn"][str(PAPER_K)]), ("cnn_softmax", asked["softmax"])):
            row, n = f"paper.{method}_{variant}.{key.replace('.', '_')}", asked["n"]
            report.row(
                f"{row}.street_accuracy", accuracy, "share", n=n, ci95=list(wilson_interval(round(accuracy * n), n))
            )
            report.row(f"{row}.mean_distance_error_m", mean_m, "m", n=n)


def _rows_of(
    report: Report,
    method: str,
    split: str,
    result: MethodResult,
    found: Mapping[str, Mapping[str, Mapping[str, float]]],
    n: int,
) -> None:
    own = found[method][split]
    others = [found[name][split] for name in found if not name.startswith("streetfix")]
    row = f"paper.{method}.{split}"
    bars: dict[str, Any] = {}
    if method in TRAINED_BY_US and others:
        best = max(each["street_accuracy"] for each in others)
        bars["street_accuracy"] = (
            best if split == "other_drive" else round(wilson_interval(round(best * n), n)[0], 4),
            "the best other method's" + ("" if split == "other_drive" else ", lower end of its 95 % interval"),
        )
        if split == "other_drive":
            bars["mean_distance_error_m"] = (min(e["mean_distance_error_m"] for e in others), "the best other method's")
    interval = list(wilson_interval(round(own["street_accuracy"] * n), n))
    for key, unit in METRICS[:3]:
        bar, what = bars.get(key, (None, None))
        better: Literal["higher", "lower"] = "higher" if key == "street_accuracy" else "lower"
        report.row(
            f"{row}.{key}",
            own[key],
            unit,
            bar=bar,
            better=better,
            n=n,
            ci95=interval if better == "higher" else None,
            why=None if what is None else f"bar: {what}",
        )
    for key in ("median_distance_error_m", "within_1_m"):
        report.row(f"{row}.{key}", own[key], "m" if key.endswith("_m") and key != "within_1_m" else "share", n=n)
    minutes = None if result.training_s is None else result.training_s / 60
    report.row(f"{row}.training_minutes", minutes, "min", n=result.training_set, why=result.ended)
