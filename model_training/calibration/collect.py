"""Ask calibration queries: of their own city's map, of another city's, of sparse ones, and of one that left some streets out."""

from collections.abc import Callable, Sequence

import numpy as np

from model_training.calibration.fit import RIGHT_M, Asked
from model_training.calibration.plans import SEQUENCE
from model_training.datasets.dataset import Dataset
from model_training.evaluation.predict import Predictions, predict
from service.localization.localizer import Localizer

Report = Callable[[str, int, int], None]


def in_the_map(localizer: Localizer, dataset: Dataset, report: Report, names: Sequence[str] = ()) -> list[Asked]:
    """Query sets of the map's own city; all of them, where none are named."""
    return [
        asked_of(_predicted(localizer, dataset, name, report), name, known=True)
        for name in names or dataset.query_sets(with_truth=True)
    ]


def of_another_city(localizer: Localizer, dataset: Dataset, report: Report, names: Sequence[str] = ()) -> list[Asked]:
    """Query sets of a city that the map does not show; all of them, where none are named."""
    return [
        asked_of(_predicted(localizer, dataset, name, report), f"other_city.{preset_of(name)}", known=False)
        for name in names or dataset.query_sets(with_truth=True)
    ]


def where_streets_are_missing(
    localizer: Localizer, dataset: Dataset, names: list[str], is_outside: Callable[[np.ndarray], np.ndarray], report: Report
) -> list[Asked]:  # fmt: skip
    """Query sets of a city whose map left streets out: those taken there, and the others."""
    found = []
    for name in names:
        predictions = predict(localizer, dataset, name, report=report)
        outside = is_outside(predictions.T_true[:, :2, 3])
        both = asked_of(predictions, name, known=True)
        found.append(_rows(asked_of(predictions, f"removed_streets.{preset_of(name)}", known=False), outside))
        found.append(_rows(both, ~outside))
    return found


def _predicted(localizer: Localizer, dataset: Dataset, name: str, report: Report) -> Predictions:
    """Sets of sequences are asked sequence by sequence."""
    return predict(
        localizer, dataset, name, frames_each=SEQUENCE if name.startswith("sequences_") else 1, report=report
    )


def preset_of(query_set: str) -> str:
    """Depth preset, the last part of a query set's name."""
    return query_set.rsplit("_", 1)[-1]


def asked_of(predictions: Predictions, kind: str, *, known: bool) -> Asked:
    """Rows of the calibration; a pose that was found outside the map by accident is wrong there."""
    distance = np.linalg.norm(predictions.T_answer[:, :2, 3] - predictions.T_true[:, :2, 3], axis=1)
    right = (np.nan_to_num(distance, nan=np.inf) <= RIGHT_M) & known
    count = len(right)
    return Asked(predictions.evidence, right, np.full(count, known), np.full(count, kind))


def _rows(asked: Asked, keep: np.ndarray) -> Asked:
    return Asked(asked.evidence[keep], asked.right[keep], asked.known[keep], asked.kind[keep])
