"""Follow simulated robots over their frames, with the errors of their odometry, and compare every answer with the ground truth."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from model_training.datasets.dataset import Dataset, QueryFrame
from model_training.evaluation.odometry import odometry_between
from service.errors import NoDepthError
from service.geometry.rigid import Transform, transform_from
from service.localization.localizer import Localizer
from service.localization.tracker import Track, follow

#: Progress callback: stage, finished steps, all steps.
Report = Callable[[str, int, int], None]


@dataclass(frozen=True, slots=True)
class Tracks:
    """Answers of R robots with K frames each.

    Attributes:
        accepted: whether the status is LOCALIZED (R, K).
        error_m: distance of the best guess from the ground truth, metres (R, K); infinity without an answer.
        epoch: number of disruptions so far (R, K).
        frames: number of frames that were registered together (R, K).
    """

    accepted: NDArray[np.bool_]
    error_m: NDArray[np.float64]
    epoch: NDArray[np.int64]
    frames: NDArray[np.int64]

    def right(self, within_m: float) -> NDArray[np.bool_]:
        """Return which answers are LOCALIZED and within a distance (R, K).

        Args:
            within_m: distance, metres.
        """
        return self.accepted & (self.error_m <= within_m)

    def wrong(self, beyond_m: float) -> NDArray[np.bool_]:
        """Return which answers are LOCALIZED and beyond a distance (R, K).

        Args:
            beyond_m: distance, metres.
        """
        return self.accepted & (self.error_m > beyond_m)


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """A frame of a robot and its odometry.

    Attributes:
        frame: the frame, with its true pose.
        T_previous_camera: odometry since the frame before; None in the first frame.
    """

    frame: QueryFrame
    T_previous_camera: Transform | None


def drives_of(dataset: Dataset, name: str, frames_each: int) -> list[list[Step]]:
    """Return the sequences of a query set, with noisy odometry.

    Args:
        dataset: dataset of the queries.
        name: name of a query set of sequences.
        frames_each: number of frames in each sequence.
    """
    frames = list(dataset.queries(name))
    return [
        steps_of(frames[k : k + frames_each], np.random.default_rng([79, k]))
        for k in range(0, len(frames), frames_each)
    ]


def steps_of(frames: Sequence[QueryFrame], rng: np.random.Generator) -> list[Step]:
    """Return consecutive frames with noisy odometry between them.

    Args:
        frames: frames with true poses.
        rng: random generator of the errors.
    """
    steps = [Step(frames[0], None)]
    for before, frame in pairwise(frames):
        steps.append(Step(frame, odometry_between(_true(before), _true(frame), rng)))
    return steps


def displaced(drives: list[list[Step]], after: int, *, step_m: float) -> list[list[Step]]:
    """Return robots that somebody carries away: the first frames of one drive, then a whole other drive.

    The odometry does not notice: it reports a straight step ahead.

    Args:
        drives: drives of the same map.
        after: number of frames before the displacement.
        step_m: length of the reported step, metres.
    """
    half, ahead = len(drives) // 2, transform_from(np.eye(3), np.array([0.0, 0.0, step_m]))
    return [
        [*drive[:after], replace(other[0], T_previous_camera=ahead), *other[1:]]
        for drive, other in zip(drives, drives[half:] + drives[:half], strict=True)
    ]


def followed(localizer: Localizer, drives: list[list[Step]], report: Report = lambda *_: None) -> Tracks:
    """Follow robots, each with a track of its own.

    Args:
        localizer: of the map.
        drives: steps of each robot, equally many.
        report: called after each robot.
    """
    shape = (len(drives), len(drives[0]))
    accepted, error_m = np.zeros(shape, np.bool_), np.full(shape, np.inf)
    epoch, frames = np.zeros(shape, np.int64), np.zeros(shape, np.int64)
    for row, drive in enumerate(drives):
        track = Track()
        for column, step in enumerate(drive):
            try:
                frame = localizer.encode_and_search(step.frame.query(localizer.bundle.grid))
            except NoDepthError:
                track = track.broken()
                epoch[row, column] = track.epoch
                continue
            answer, track = follow(localizer, frame, track, step.T_previous_camera)
            apart = answer.T_map_camera_guess[:2, 3] - _true(step.frame)[:2, 3]
            accepted[row, column] = answer.status == "LOCALIZED"
            error_m[row, column] = float(np.hypot(*apart))
            epoch[row, column], frames[row, column] = answer.epoch, answer.frames
        report("tracks", row + 1, len(drives))
    return Tracks(accepted, error_m, epoch, frames)


def _true(frame: QueryFrame) -> Transform:
    if frame.T_map_camera is None:
        raise ValueError("the frame has no true pose")
    return frame.T_map_camera
