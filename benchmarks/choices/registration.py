"""What registration brings, and what its weights do, in the watch city."""

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
from service.localization import refine
from service.localization.localizer import Localizer
from service.registration.kernel import QueryPoints
from service.registration.points import PointSettings

#: The function of ``refine`` that makes points; its result is changed here.
POINTS = "points_from"
Sureness = Callable[[QueryPoints], QueryPoints]


def alike(points: QueryPoints) -> QueryPoints:
    """Every point as sure as the median one."""
    return replace(points, sigma=np.full_like(points.sigma, np.median(points.sigma)))


def as_it_is(points: QueryPoints) -> QueryPoints:
    """Each point as uncertain as its distance makes it."""
    return points


#: How points count: the function that says how sure they are, and the settings.
WEIGHTS: dict[str, tuple[Sureness, PointSettings]] = {
    "weighted": (as_it_is, PointSettings()),
    "unweighted": (alike, PointSettings()),
    "movable_as_others": (as_it_is, PointSettings(movable_weight=1.0)),
}


def registration_rows(report: Report, runs: Runs, dataset: Dataset) -> None:
    """Distance errors without registration, with it, and with its weights switched off; every query forced to answer."""
    bundle, points_from = runs.bundle(dataset), getattr(refine, POINTS)
    plain = Localizer.open(bundle)
    for name in dataset.query_sets(with_truth=True):
        with bars() as show:
            found = {"none": predict(plain, dataset, name, refine=False, report=show)}
        for how, (sureness, settings) in WEIGHTS.items():
            weighed = Localizer(bundle, plain.encoder, refining=replace(plain.refining, points=settings))

            def points(*given: Any, _as: Sureness = sureness, **named: Any) -> QueryPoints:
                return _as(points_from(*given, **named))

            with bars() as show, patch.object(refine, POINTS, points):
                found[how] = predict(weighed, dataset, name, report=show)
        for how, answers in found.items():
            row = f"choices.registration.{how}.{name.rpartition('_')[2]}"
            away = distance_errors(answers.T_answer[:, :2, 3], answers.T_true[:, :2, 3])
            report.share(f"{row}.forced_within_1_m", within(answers, 1.0))
            report.row(f"{row}.median_distance_error_m", float(np.nanmedian(away)), "m", better="lower", n=len(away))
