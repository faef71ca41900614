"""A saved evaluation as events: ground truth, neighbours, registered candidates and answer of every query."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from model_training.datasets.dataset import Dataset, QueryFrame
from model_training.evaluation.failures import Stage, position_errors, stages
from model_training.evaluation.predict import Predictions
from model_training.evaluation.saved_run import SavedRun
from model_training.viewing.events import Event, Note, Poses, Track
from model_training.viewing.of_dataset import STEP_S, view_of
from service.geometry.rigid import R_BODY_OPTICAL, rotation_z, transform_from


def events_of_answers(run: SavedRun, dataset: Dataset | None) -> Iterator[Event]:
    """Yield the events of all queries in the order of the sets; images need the dataset.

    Args:
        run: saved evaluation.
        dataset: dataset of the queries; None if absent.
    """
    now_s, last = 0.0, run.settings.mode.frames - 1  # a query asks for the pose of its last image
    for name, p in run.predictions.items():
        frames = [] if dataset is None else list(dataset.queries(name))
        became, errors = stages(p), position_errors(p)
        for row in range(len(p.T_true)):
            yield from _query(p, row, now_s, frames[row + last] if frames else None)
            off = f"{errors[row]:.2f} m off" if np.isfinite(errors[row]) else "no answer"
            sure = "" if np.isnan(p.confidence[row]) else f", confidence {p.confidence[row]:.2f}"
            text = f"{name}, query {row + last}: {became[row]}; {off}{sure}"
            yield Note("answer/log", now_s, text, became[row] is Stage.RIGHT)
            now_s += STEP_S


def _query(p: Predictions, row: int, now_s: float, frame: QueryFrame | None) -> Iterator[Event]:
    T_true = p.T_true[row]
    yield Poses("query/truth", now_s, T_true[None])
    if frame is not None:
        yield view_of(frame, now_s, T_true)
    height_m = float(T_true[2, 3])
    neighbours = p.ranked_xy[row][np.isfinite(p.ranked_xy[row, :, 0])]
    yield Poses("answer/neighbours", now_s, upright(np.column_stack([neighbours, np.zeros(len(neighbours))]), height_m))
    yield Poses("answer/hypotheses", now_s, upright(p.hypotheses[row, :, :3], height_m))
    yield Poses("answer/registered", now_s, upright(p.candidates[row, :, :3], height_m))
    answered = np.isfinite(p.T_answer[row]).all()
    yield Poses("answer/pose", now_s, p.T_answer[row][None] if answered else np.empty((0, 4, 4)))
    ends = [T_true[:3, 3], p.T_answer[row, :3, 3]] if answered else []
    yield Track("answer/error", now_s, np.array(ends).reshape(-1, 3))


def upright(xy_heading: NDArray[np.float64], height_m: float) -> NDArray[np.float64]:
    """Return level camera poses T_map_camera (m, 4, 4) of the finite rows.

    Args:
        xy_heading: x, y in metres and heading in radians (n, 3), map frame.
        height_m: height of the cameras, metres, map frame.
    """
    finite = xy_heading[np.isfinite(xy_heading).all(axis=1)]
    poses = [
        transform_from(rotation_z(heading) @ R_BODY_OPTICAL, np.array([x, y, height_m])) for x, y, heading in finite
    ]
    return np.array(poses, np.float64).reshape(-1, 4, 4)
