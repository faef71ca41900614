"""Evaluate a map on a dataset: predictions, measures, the split of each query set, trajectories."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from model_training.datasets.dataset import Dataset, write_tum
from model_training.evaluation.measures import measure
from model_training.evaluation.predict import Predictions, joined
from model_training.evaluation.query_mode import SINGLE, QueryMode, predict_in_mode
from service.errors import DatasetError
from service.localization.localizer import Localizer
from service.maps.map import Map

#: Progress callback: stage, finished steps, all steps.
Report = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Evaluation:
    """The result of an evaluation.

    Attributes:
        figures: all figures as JSON values.
        predictions: the predictions of each query set, by its name.
    """

    figures: dict[str, Any]
    predictions: dict[str, Predictions] = field(default_factory=dict)


def evaluate(
    bundle: Map,
    dataset: Dataset,
    names: list[str] | None = None,
    *,
    mode: QueryMode = SINGLE,
    refine: bool = True,
    workers: int = 2,
    report: Report = lambda *_: None,
) -> Evaluation:
    """Measure a map with query sets.

    The top-level figures are over all queries of all sets. ``sets`` holds the figures of each set with its split.

    Args:
        bundle: the map.
        dataset: the dataset with the queries. If it has another georeference than the map, it is moved into the frame of the map.
        names: names of the query sets; None takes all sets with ground truth.
        mode: how the images become queries. ``figures["mode"]`` has it, and ``odometry`` of a set says where relative poses come from.
        refine: register the answers. False measures retrieval alone.
        workers: number of queries that are localized at the same time.
        report: called after every query.

    Raises:
        DatasetError: there is no query set with ground truth, or a set does not fit the mode.
    """
    dataset = dataset.in_frame(bundle.manifest.georeference)
    names = names or dataset.query_sets(with_truth=True)
    if not names:
        raise DatasetError(
            f"{dataset.folder} has no query set with poses.txt, so nothing can be measured", field="queries"
        )
    localizer = Localizer.open(bundle)
    classes = [] if bundle.streets is None else [street.name for street in bundle.streets.features]
    predictions, odometry = dict[str, Predictions](), dict[str, str | None]()
    for name in names:
        predictions[name], odometry[name] = predict_in_mode(
            localizer, dataset, name, mode, refine=refine, workers=workers, report=report
        )
    figures = measure(joined(list(predictions.values())), classes)
    seen = city_seen_in_training(dataset, localizer.encoder.trained_on)
    sets = {
        name: {"split": split_of(dataset, name, seen), "city_seen_in_training": seen, "odometry": odometry[name]}
        | measure(p, classes)
        for name, p in predictions.items()
    }
    splits = sorted({str(s["split"]) for s in sets.values()})
    head = {
        "map": {"name": bundle.name, "version": bundle.manifest.version},
        "dataset": dataset.name,
        "split": splits[0] if len(splits) == 1 else "mixed",
        "encoder_sha256": bundle.manifest.encoder_sha256,
        "registered": refine and bundle.cloud is not None,
        "mode": mode.model_dump(),
    }
    return Evaluation(head | figures | {"sets": sets}, predictions)


def city_seen_in_training(dataset: Dataset, trained_on: tuple[str, ...]) -> bool | None:
    """Return whether the encoder was trained on the dataset's city; None if the encoder does not name its training cities.

    Args:
        dataset: the dataset.
        trained_on: names of the training cities, as the encoder gives them.
    """
    if not trained_on:
        return None
    source = dataset.description.source
    plan = source.get("plan") or {}
    if source.get("kind") != "simulation":
        return False
    return f"{plan.get('city')}-{plan.get('seed')}" in trained_on


def split_of(dataset: Dataset, name: str, city_seen: bool | None) -> str:
    """Return the split of a query set.

    A set of a real recording is ``same_drive`` unless the ``source`` of the dataset lists it among its ``other_drives``. So an evaluation
    never claims without evidence that queries and map come from different traversals.

    Args:
        dataset: the dataset.
        name: name of the query set.
        city_seen: whether the encoder was trained on this city; None if unknown.

    Returns:
        ``same_drive``: queries from the survey traversal, as in the paper; test data leaks into the map. ``other_drive``: queries from
        another traversal. ``unseen_city``: from another traversal, in a city that the encoder was not trained on.
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
    return True  # the plan does not list the set, so its origin is unknown: assume the worst case


def write_trajectory(path: Path, predictions: Predictions) -> None:
    """Write the accepted poses T_map_camera in TUM format, each with the timestamp of its ground truth.

    ``rms_distance_error_m`` is computed from the same poses. Without a calibration of the map, every answer is accepted.

    Args:
        path: file to write.
        predictions: the answers.
    """
    answered = predictions.localized & np.isfinite(predictions.T_answer[:, 0, 3])
    write_tum(path, predictions.stamp_s[answered], predictions.T_answer[answered])
