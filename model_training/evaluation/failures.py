"""Find the stage that lost a query, from the stored part of its answer."""

from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from model_training.evaluation.error_measures import distance_errors
from model_training.evaluation.measures import RIGHT_PLACE_M, recall_at
from model_training.evaluation.predict import RANKED, Predictions
from service.maps.calibration import RIGHT_M


class Stage(StrEnum):
    """The outcome of a query, in the words of a report. ``WHY`` explains each."""

    RIGHT = "right"
    DOUBTED = "right, but not accepted"
    IMPRECISE = "right place, imprecise"
    ELSEWHERE = "another place chosen"
    STARTS = "no initial pose near the truth"
    RETRIEVAL = "lost by retrieval"
    REFUSED = "refused"


#: Explanation of each outcome for the report.
WHY = {
    Stage.RIGHT: "The answer is within 1 m of the truth and was accepted.",
    Stage.DOUBTED: "The position is within 1 m, but its confidence did not reach the threshold, so it was not accepted.",
    Stage.IMPRECISE: "The answer lies 1 to 5 m off: the right place, not the right pose.",
    Stage.ELSEWHERE: (
        "A candidate pose was near the truth, or the right place was among the ten nearest; another one had more "
        "support."
    ),
    Stage.STARTS: "The right place is among the ten nearest, but after registration no candidate pose was near it.",
    Stage.RETRIEVAL: "No place within 5 m of the truth is among the ten nearest, and no pose near it was registered.",
    Stage.REFUSED: "The depth image has no usable measurement, so there is no answer.",
}


def position_errors(predictions: Predictions) -> NDArray[np.float64]:
    """Return the distance of every answer, accepted or not, from its ground truth, metres (n,); infinite without an answer.

    Args:
        predictions: the answers.
    """
    errors = distance_errors(predictions.T_answer[:, :2, 3], predictions.T_true[:, :2, 3])
    return np.where(np.isfinite(errors), errors, np.inf)


def stages(predictions: Predictions) -> list[Stage]:
    """Return the outcome of each query, in order.

    Args:
        predictions: the answers.
    """
    errors, true_xy = position_errors(predictions), predictions.T_true[:, :2, 3]
    among_ten = recall_at(predictions.ranked_xy, true_xy, RANKED)
    registered = np.isfinite(predictions.candidates[:, 0, 0])
    off = np.linalg.norm(predictions.candidates[..., :2] - true_xy[:, None], axis=2)
    candidate_near = (np.nan_to_num(off, nan=np.inf) <= RIGHT_PLACE_M).any(axis=1)
    return [
        _stage(
            errors[k], bool(predictions.localized[k]), bool(among_ten[k]), bool(registered[k]), bool(candidate_near[k])
        )
        for k in range(len(errors))
    ]


def _stage(error_m: float, accepted: bool, among_ten: bool, registered: bool, candidate_near: bool) -> Stage:
    if not np.isfinite(error_m):
        return Stage.REFUSED
    if error_m <= RIGHT_M:
        return Stage.RIGHT if accepted else Stage.DOUBTED
    if error_m <= RIGHT_PLACE_M:
        return Stage.IMPRECISE
    if candidate_near:
        return Stage.ELSEWHERE
    if not among_ten:
        return Stage.RETRIEVAL
    return Stage.STARTS if registered else Stage.ELSEWHERE


def worst(predictions: Predictions, count: int) -> list[int]:
    """Return the rows of the worst queries, the worst first.

    Wrong accepted answers come first, because they do harm. Then come the other wrong answers, then the right ones. Each group is sorted
    by distance, the largest first.

    Args:
        predictions: the answers.
        count: largest number of rows.
    """
    errors = position_errors(predictions)
    wrong = errors > RIGHT_M
    harmful = wrong & predictions.localized
    order = np.lexsort((-errors, ~wrong, ~harmful))
    return [int(k) for k in order[:count]]
