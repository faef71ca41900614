"""Localize the calibration queries in several maps: of their own city, of another city, sparse ones, and one without some streets.

Walls and rooms serve as out-of-map queries too.
"""

import re
from collections.abc import Callable, Sequence

import numpy as np

from model_training.calibration.fit import CalibrationData
from model_training.calibration.out_of_map import KINDS, out_of_map_queries
from model_training.calibration.plans import SEQUENCE
from model_training.calibration.rigs import Rig
from model_training.datasets.dataset import Dataset
from model_training.evaluation.pose_errors import pose_errors
from model_training.evaluation.predict import Predictions, predict
from model_training.simulation.depth_noise import DepthModel
from service.confidence.features import FEATURES
from service.errors import NoDepthError
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import heading_of_camera
from service.localization.localizer import Localizer
from service.maps.calibration import RIGHT_M
from service.retrieval.query import Query

#: Progress callback: stage, finished steps, all steps.
Report = Callable[[str, int, int], None]


def in_the_map(
    localizer: Localizer, dataset: Dataset, report: Report, names: Sequence[str] = (), *, rig: Rig | None = None
) -> list[CalibrationData]:
    """Localize query sets of the map's own city.

    Args:
        localizer: the localizer of the map.
        dataset: the dataset with the queries.
        report: called after every query.
        names: names of the query sets; empty for all sets with ground truth.
        rig: rig of the queries; None for the dataset's own camera.
    """
    return [
        calibration_data_of(_predicted(localizer, dataset, name, report, rig), _by(rig, name), known=True)
        for name in names or dataset.query_sets(with_truth=True)
    ]


def of_another_city(
    localizer: Localizer, dataset: Dataset, report: Report, names: Sequence[str] = (), *, rig: Rig | None = None
) -> list[CalibrationData]:
    """Localize query sets of a city that the map does not cover: out-of-map queries.

    Args:
        localizer: the localizer of the map of another city.
        dataset: the dataset with the queries.
        report: called after every query.
        names: names of the query sets; empty for all sets with ground truth.
        rig: rig of the queries; None for the dataset's own camera.
    """
    return [
        calibration_data_of(
            _predicted(localizer, dataset, name, report, rig), _by(rig, f"other_city.{preset_of(name)}"), known=False
        )
        for name in names or dataset.query_sets(with_truth=True)
    ]


def where_streets_are_missing(
    localizer: Localizer,
    dataset: Dataset,
    names: list[str],
    is_outside: Callable[[np.ndarray], np.ndarray],
    report: Report,
) -> list[CalibrationData]:
    """Localize query sets in a map of their city without some streets.

    Args:
        localizer: the localizer of the map without these streets.
        dataset: the dataset with the queries.
        names: names of the query sets.
        is_outside: returns for each position (n, 2), metres, map frame, whether it lies in a missing street (n,).
        report: called after every query.

    Returns:
        For each set its out-of-map queries, from the missing streets, then its other queries.
    """
    found = []
    for name in names:
        predictions = predict(localizer, dataset, name, report=report)
        outside = is_outside(predictions.T_true[:, :2, 3])
        both = calibration_data_of(predictions, name, known=True)
        found.append(calibration_data_of(predictions, f"removed_streets.{preset_of(name)}", known=False).where(outside))
        found.append(both.where(~outside))
    return found


def walls_and_rooms(
    localizer: Localizer,
    camera: PinholeCamera,
    seed: int,
    report: Report,
    models: Sequence[DepthModel],
    *,
    count: int = 100,
    rig: Rig | None = None,
) -> list[CalibrationData]:
    """Localize simulated walls and rooms, which no map contains.

    Args:
        localizer: the localizer of a map.
        camera: camera of the images.
        seed: seed of the random generator.
        report: called after every query.
        models: the depth cameras.
        count: number of queries of each kind and depth camera.
        rig: rig of the queries; None for the camera itself.
    """
    found = []
    for number, kind in enumerate(KINDS):
        for order, model in enumerate(models):
            rng = np.random.default_rng([seed, number, order])
            evidence = np.full((count, len(FEATURES)), np.nan)
            for k, query in enumerate(out_of_map_queries(kind, camera, model, count, rng)):
                evidence[k] = _evidence(localizer, query if rig is None else rig.seen(query))
                report(_by(rig, f"walls and rooms {kind}_{model.name}"), k + 1, count)
            found.append(
                CalibrationData(
                    evidence=evidence,
                    right=np.zeros(count, bool),
                    known=np.zeros(count, bool),
                    kind=np.full(count, _by(rig, f"{kind}.{model.name}")),
                    family=np.full(count, model.name),
                    error=np.full((count, 6), np.nan),
                    covariance=np.full((count, 6, 6), np.nan),
                    heading_rad=np.full(count, np.nan),
                )
            )
    return found


def _evidence(localizer: Localizer, query: Query) -> np.ndarray | float:
    """Return the confidence features of the answer; NaN without registration."""
    try:
        evidence = localizer.localize(query).evidence
    except NoDepthError:
        return np.nan
    return np.nan if evidence is None else evidence


def _predicted(
    localizer: Localizer, dataset: Dataset, name: str, report: Report, rig: Rig | None = None
) -> Predictions:
    """Localize a query set; the frames of a sequence, or of several cameras, are one query."""
    together = 1 if rig is None else rig.cameras
    frames_each = SEQUENCE if name.startswith("sequences_") else together
    seen_by = None if rig is None else rig.seen
    return predict(localizer, dataset, name, frames_each=frames_each, seen_by=seen_by, report=report)


def _by(rig: Rig | None, kind: str) -> str:
    """Return the name of a kind of queries for a rig. The depth preset stays its last part."""
    return kind if rig is None else f"{rig.name}_{kind}"


def preset_of(query_set: str) -> str:
    """Return the depth preset of a query set or a kind of queries: the last part of its name.

    Args:
        query_set: name of the set or the kind.
    """
    return re.split(r"[._]", query_set)[-1]


def calibration_data_of(predictions: Predictions, kind: str, *, known: bool) -> CalibrationData:
    """Return the rows of the calibration data for the predictions of a query set.

    The answer to an out-of-map query always counts as wrong, even if its position is close by accident.

    Args:
        predictions: the answers.
        kind: kind of the queries.
        known: whether the queries lie in the map.
    """
    distance = np.linalg.norm(predictions.T_answer[:, :2, 3] - predictions.T_true[:, :2, 3], axis=1)
    right = (np.nan_to_num(distance, nan=np.inf) <= RIGHT_M) & known
    count = len(right)
    return CalibrationData(
        evidence=predictions.evidence,
        right=right,
        known=np.full(count, known),
        kind=np.full(count, kind),
        family=np.full(count, preset_of(kind)),
        error=pose_errors(predictions.T_answer, predictions.T_true) if known else np.full((count, 6), np.nan),
        covariance=predictions.covariance,
        heading_rad=np.array([heading_of_camera(T) if known else np.nan for T in predictions.T_true]),
    )
