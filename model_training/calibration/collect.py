"""Ask calibration queries: of their own city's map, of another's, of sparse ones, of one without some streets; and walls and rooms."""

from collections.abc import Callable, Sequence

import numpy as np

from model_training.calibration.fit import RIGHT_M, Asked
from model_training.calibration.plans import BOTH, SEQUENCE
from model_training.calibration.rigs import Rig
from model_training.calibration.strangers import KINDS, strangers
from model_training.datasets.dataset import Dataset
from model_training.evaluation.predict import Predictions, predict
from service.errors import NoDepthError
from service.geometry.camera import PinholeCamera
from service.localization.localizer import Localizer
from service.localization.query import Query
from service.maps.calibration import FEATURES

Report = Callable[[str, int, int], None]


def in_the_map(
    localizer: Localizer, dataset: Dataset, report: Report, names: Sequence[str] = (), *, rig: Rig | None = None
) -> list[Asked]:
    """Query sets of the map's own city, by the simulated camera or another rig; all of them, where none are named."""
    return [
        asked_of(_predicted(localizer, dataset, name, report, rig), _by(rig, name), known=True)
        for name in names or dataset.query_sets(with_truth=True)
    ]


def of_another_city(
    localizer: Localizer, dataset: Dataset, report: Report, names: Sequence[str] = (), *, rig: Rig | None = None
) -> list[Asked]:
    """Query sets of a city that the map does not show, by the simulated camera or another rig; all of them, where none are named."""
    return [
        asked_of(
            _predicted(localizer, dataset, name, report, rig), _by(rig, f"other_city.{preset_of(name)}"), known=False
        )
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


def walls_and_rooms(
    localizer: Localizer, camera: PinholeCamera, seed: int, report: Report, *, count: int = 100, rig: Rig | None = None
) -> list[Asked]:
    """Pictures of what is in no map, so many of each kind and depth preset, by the simulated camera or another rig."""
    found = []
    for number, kind in enumerate(KINDS):
        for preset in BOTH:
            rng = np.random.default_rng([seed, number, BOTH.index(preset)])
            evidence = np.full((count, len(FEATURES)), np.nan)
            for k, query in enumerate(strangers(kind, camera, preset, count, rng)):
                evidence[k] = _evidence(localizer, query if rig is None else rig.seen(query))
                report(_by(rig, f"strangers {kind}_{preset}"), k + 1, count)
            nowhere = np.zeros(count, bool)
            found.append(Asked(evidence, nowhere, nowhere, np.full(count, _by(rig, f"{kind}.{preset}"))))
    return found


def _evidence(localizer: Localizer, query: Query) -> np.ndarray | float:
    """NaN where nothing was registered."""
    try:
        evidence = localizer.localize(query).evidence
    except NoDepthError:
        return np.nan
    return np.nan if evidence is None else evidence


def _predicted(
    localizer: Localizer, dataset: Dataset, name: str, report: Report, rig: Rig | None = None
) -> Predictions:
    """Sets of sequences are asked sequence by sequence."""
    return predict(
        localizer, dataset, name, frames_each=SEQUENCE if name.startswith("sequences_") else 1,
        seen_by=None if rig is None else rig.seen, report=report,
    )  # fmt: skip


def _by(rig: Rig | None, kind: str) -> str:
    """Kinds of other rigs are kinds of their own; the preset stays their last part."""
    return kind if rig is None else f"{rig.name}_{kind}"


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
