"""Pass 2 of an evaluation: compute figures from predictions.

Shares are over all queries. A query without an accepted answer counts as wrong. Distances are over the accepted answers. The forced
figures (``forced``) are over the best hypothesis of every query that has one.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from model_training.evaluation.error_measures import (
    distance_errors,
    error_rate,
    heading_errors_deg,
    mean_error_distance,
    mean_squared_error,
    root_mean_squared_error,
    wilson_interval,
)
from model_training.evaluation.predict import Predictions, headings_of
from service.maps.calibration import RIGHT_M

#: Largest distance of a right place, metres on the ground.
RIGHT_PLACE_M = 5.0


def recall_at(
    ranked_xy: NDArray[np.float64], true_xy: NDArray[np.float64], k: int, *, within_m: float = RIGHT_PLACE_M
) -> NDArray[np.bool_]:
    """Return for each query whether one of the first k distinct places is within reach of the ground truth (n,).

    Args:
        ranked_xy: positions of the retrieved places, the best first, NaN where there are fewer, metres, map frame (n, K, 2).
        true_xy: true positions, metres, map frame (n, 2).
        k: number of places that count.
        within_m: largest distance of a right place, metres.
    """
    distance = np.linalg.norm(ranked_xy[:, :k] - true_xy[:, None], axis=2)
    return np.asarray((np.nan_to_num(distance, nan=np.inf) <= within_m).any(axis=1))


def label_of(key: str, label: str, *, registered: bool) -> str:
    """Return the label of a figure for readers. Registration sorts the retrieved places again, so the label of a recall says it.

    Args:
        key: name of the figure.
        label: its label without registration.
        registered: whether the answers were registered.
    """
    return f"{label}, after registration" if registered and key.startswith("recall_at") else label


def measure(predictions: Predictions, street_names: list[str]) -> dict[str, Any]:
    """Compute all figures of one query set as JSON values; ``ci95`` holds Wilson intervals of the shares.

    Args:
        predictions: the answers.
        street_names: names of the map's streets, in the order of their features.
    """
    p, count = predictions, len(predictions.T_true)
    true_xy = p.T_true[:, :2, 3]
    has_pose = np.isfinite(p.T_answer[:, 0, 3])
    answered = p.localized & has_pose
    distance = np.full(count, np.inf)
    distance[has_pose] = distance_errors(p.T_answer[has_pose, :2, 3], true_xy[has_pose])
    shown = np.where(answered, distance, np.inf)
    shares: dict[str, NDArray[np.bool_]] = {
        "within_0_5_m": shown <= 0.5,
        "within_1_m": shown <= RIGHT_M,
        "within_5_m": shown <= RIGHT_PLACE_M,
        "recall_at_1_5m": recall_at(p.ranked_xy, true_xy, 1),
        "recall_at_5_5m": recall_at(p.ranked_xy, true_xy, 5),
        "recall_at_10_5m": recall_at(p.ranked_xy, true_xy, 10),
        "recall_at_1_10m": recall_at(p.ranked_xy, true_xy, 1, within_m=10.0),
        "localized": answered,
    }
    in_street = p.street_true >= 0
    if in_street.any():
        shares["street_accuracy"] = (answered & (p.street_answer == p.street_true))[in_street]
    result: dict[str, Any] = {"queries": count, "street_queries": int(in_street.sum())}
    result |= {name: float(np.mean(flags)) for name, flags in shares.items()}
    result.setdefault("street_accuracy", None)
    result["error_rate"] = error_rate(shares["street_accuracy"]) if in_street.any() else None
    result |= _distances(distance[answered])
    result["accepted_wrong"] = float(np.mean(answered & (distance > RIGHT_M)))
    forced = {
        "within_0_5_m": distance <= 0.5,
        "within_1_m": distance <= RIGHT_M,
        "within_5_m": distance <= RIGHT_PLACE_M,
    }
    result["forced"] = _distances(distance[has_pose]) | {"answered": float(np.mean(has_pose))}
    result["forced"] |= {name: float(np.mean(flags)) for name, flags in forced.items()}
    known = np.isfinite(p.confidence)
    result["median_confidence"] = float(np.median(p.confidence[known])) if known.any() else None
    headings = (
        heading_errors_deg(headings_of(p.T_answer[answered]), headings_of(p.T_true[answered]))
        if answered.any()
        else None
    )
    result["median_heading_error_deg"] = None if headings is None else float(np.median(headings))
    result["ms_per_query"] = float(np.median(p.ms))
    result["ci95"] = {name: list(wilson_interval(int(flags.sum()), len(flags))) for name, flags in shares.items()}
    result["confusion"] = _confusion(p, street_names) if in_street.any() else None
    return result


def _distances(distance: NDArray[np.float64]) -> dict[str, float | None]:
    if not len(distance):
        keys = (
            "mean_distance_error_m",
            "median_distance_error_m",
            "p95_distance_error_m",
            "rms_distance_error_m",
            "mse_m2",
        )
        return dict.fromkeys(keys)
    return {
        "mean_distance_error_m": mean_error_distance(distance),
        "median_distance_error_m": float(np.median(distance)),
        "p95_distance_error_m": float(np.percentile(distance, 95)),
        "rms_distance_error_m": root_mean_squared_error(distance),
        "mse_m2": mean_squared_error(distance),
    }


def _confusion(p: Predictions, names: list[str]) -> dict[str, Any]:
    """Return the confusion matrix: a row per true street, a column per answered one. The last column means no street or no answer."""
    matrix = np.zeros((len(names), len(names) + 1), int)
    answer = np.where(p.localized, p.street_answer, -1)
    for true, found in zip(p.street_true, answer, strict=True):
        if true >= 0:
            matrix[true, found] += 1
    return {"classes": names, "matrix": matrix.tolist()}
