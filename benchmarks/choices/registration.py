"""Effect of registration, and of its point weights, in the validation city."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any
from unittest.mock import patch

import numpy as np

from benchmarks.report import Report
from benchmarks.runs import Runs, within
from model_training.cli.progress import bars
from model_training.datasets.dataset import Dataset
from model_training.evaluation.error_measures import distance_errors
from model_training.evaluation.predict import predict
from service.localization.localizer import Localizer
from service.registration.kernel import QueryPoints
from service.registration.points import PointSettings
from service.scoring import measured

#: The function of ``scoring.measured`` that makes points. The benchmark patches it to change the result.
POINTS = "points_from"
Sureness = Callable[[QueryPoints], QueryPoints]


def alike(points: QueryPoints) -> QueryPoints:
    """Give every point the median standard deviation.

    Args:
        points: points of a query.
    """
    return replace(points, sigma=np.full_like(points.sigma, np.median(points.sigma)))


def as_it_is(points: QueryPoints) -> QueryPoints:
    """Keep the standard deviation of each point, which depends on its range.

    Args:
        points: points of a query.
    """
    return points


#: Variants by row name: a function that sets the standard deviations, and the settings.
WEIGHTS: dict[str, tuple[Sureness, PointSettings]] = {
    "weighted": (as_it_is, PointSettings()),
    "unweighted": (alike, PointSettings()),
    "movable_as_others": (as_it_is, PointSettings(movable_weight=1.0)),
}


def registration_rows(report: Report, runs: Runs, dataset: Dataset) -> None:
    """Add distance errors without registration, with it, and without its weights; forced figures.

    Args:
        report: collects the rows.
        runs: simulates, builds and answers, or reuses what is kept on disk.
        dataset: the validation city.
    """
    bundle, points_from = runs.bundle(dataset), getattr(measured, POINTS)
    plain = Localizer.open(bundle)
    for name in dataset.query_sets(with_truth=True):
        with bars() as show:
            found = {"none": predict(plain, dataset, name, refine=False, report=show)}
        for how, (sureness, settings) in WEIGHTS.items():
            weighed = Localizer(bundle, plain.encoder, refining=replace(plain.refining, points=settings))

            def points(*given: Any, _as: Sureness = sureness, **named: Any) -> QueryPoints:
                return _as(points_from(*given, **named))

            with bars() as show, patch.object(measured, POINTS, points):
                found[how] = predict(weighed, dataset, name, report=show)
        for how, answers in found.items():
            row = f"choices.registration.{how}.{name.rpartition('_')[2]}"
            away = distance_errors(answers.T_answer[:, :2, 3], answers.T_true[:, :2, 3])
            report.share(f"{row}.forced_within_1_m", within(answers, 1.0))
            report.row(f"{row}.median_distance_error_m", float(np.nanmedian(away)), "m", better="lower", n=len(away))
