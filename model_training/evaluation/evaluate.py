"""One map against one dataset: predictions, measures, the split each set belongs to, trajectories."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from model_training.datasets.dataset import Dataset, write_tum
from model_training.evaluation.measures import measure
from model_training.evaluation.predict import Predictions, joined, predict
from service.errors import DatasetError
from service.localization.localizer import Localizer
from service.maps.reader import MapBundle

Report = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Evaluation:
    """Figures as JSON values, and the predictions of each set that they were made from."""

    figures: dict[str, Any]
    predictions: dict[str, Predictions] = field(default_factory=dict)


def evaluate(
    bundle: MapBundle,
    dataset: Dataset,
    names: list[str] | None = None,
    *,
    refine: bool = True,
    workers: int = 2,
    report: Report = lambda *_: None,
) -> Evaluation:
    """Measure a map with query sets; all that have truth where none is named. ``refine=False`` measures retrieval alone.

    The figures at the top are over all queries of all sets; ``sets`` has them for each set with its split.

    Raises:
        DatasetError: there is no query set with truth.
    """
    names = names or dataset.query_sets(with_truth=True)
    if not names:
        raise DatasetError(
            f"{dataset.folder} has no query set with poses.txt, so nothing can be measured", field="queries"
        )
    localizer = Localizer.open(bundle)
    classes = [] if bundle.streets is None else [street.name for street in bundle.streets.features]
    predictions = {
        name: predict(localizer, dataset, name, refine=refine, workers=workers, report=report) for name in names
    }
    figures = measure(joined(list(predictions.values())), classes)
    seen = city_seen_in_training(dataset, localizer.encoder.trained_on)
    sets = {
        name: {"split": split_of(dataset, name, seen), "city_seen_in_training": seen} | measure(p, classes)
        for name, p in predictions.items()
    }
    splits = sorted({str(s["split"]) for s in sets.values()})
    head = {
        "map": {"name": bundle.name, "version": bundle.manifest.version}, "dataset": dataset.name,
        "split": splits[0] if len(splits) == 1 else "mixed", "encoder_sha256": bundle.manifest.encoder_sha256,
        "registered": refine and bundle.cloud is not None,
    }  # fmt: skip
    return Evaluation(head | figures | {"sets": sets}, predictions)


def city_seen_in_training(dataset: Dataset, trained_on: tuple[str, ...]) -> bool | None:
    """Whether the encoder saw this city; None where the encoder does not say what it was trained on."""
    if not trained_on:
        return None
    source = dataset.description.source
    plan = source.get("plan") or {}
    if source.get("kind") != "simulation":
        return False
    return f"{plan.get('city')}-{plan.get('seed')}" in trained_on


def split_of(dataset: Dataset, name: str, city_seen: bool | None) -> str:
    """``same_drive`` (the paper's way; it leaks), ``other_drive`` (honest), or ``unseen_city`` (and new to the encoder).

    A recording whose ``source`` does not list the set among its ``other_drives`` is taken for the survey's own drive:
    that a query and the map are of two moments must be said, not guessed.
    """
    if _is_of_the_survey(dataset.description.source, name):
        return "same_drive"
    return "unseen_city" if city_seen is False else "other_drive"


def _is_of_the_survey(source: dict[str, Any], name: str) -> bool:
    if source.get("kind") != "simulation":
        return name not in source.get("other_drives", ())
    for query in (source.get("plan") or {}).get("queries", []):
        if name in {f"{query.get('name')}_{depth}" for depth in query.get("depths", [])}:
            return bool(query.get("on_track") or query.get("traversal") == 0)
    return True  # a set that the plan does not have was put there by somebody


def write_trajectory(path: Path, predictions: Predictions) -> None:
    """Write the accepted poses, T_map_camera, in TUM format, each with the timestamp of its truth.

    They are those that ``rms_distance_error_m`` is of; where a map is not calibrated, every answer is accepted.
    """
    answered = predictions.localized & np.isfinite(predictions.T_answer[:, 0, 3])
    write_tum(path, predictions.stamp_s[answered], predictions.T_answer[answered])
