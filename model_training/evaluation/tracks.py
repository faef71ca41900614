"""Follow simulated robots over their frames, with the errors of their odometry, and compare every answer with the ground truth."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from model_training.datasets.dataset import Dataset, QueryFrame, Transforms
from model_training.evaluation.odometry import odometry_between
from model_training.evaluation.predict import PriorOf
from service.errors import NoDepthError
from service.geometry.rigid import Transform, inverse, transform_from
from service.localization.answer import Answer
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


def steps_of(
    frames: Sequence[QueryFrame], rng: np.random.Generator, T_odom_camera: Transforms | None = None
) -> list[Step]:
    """Return consecutive frames with odometry between them.

    Args:
        frames: frames with true poses.
        rng: random generator of the errors.
        T_odom_camera: recorded odometry of the frames (n, 4, 4), metres; None for the true steps with errors.
    """
    steps = [Step(frames[0], None)]
    for number, (before, frame) in enumerate(pairwise(frames)):
        if T_odom_camera is None:
            T_previous_camera = odometry_between(_true(before), _true(frame), rng)
        else:
            T_previous_camera = inverse(T_odom_camera[number]) @ T_odom_camera[number + 1]
        steps.append(Step(frame, T_previous_camera))
    return steps


def answers_on(
    localizer: Localizer, drive: Sequence[Step], *, ranked: int = 0, prior_of: PriorOf | None = None
) -> Iterator[tuple[Answer | None, Track, float]]:
    """Yield for each step of a robot the answer, the track after it, and the duration in milliseconds.

    Args:
        localizer: of the map.
        drive: the steps.
        ranked: number of distinct places in an answer.
        prior_of: returns the prior of the first image; None for no prior.

    Yields:
        The answer is None if the image has no depth. The track then begins again.
    """
    track = Track()
    for number, step in enumerate(drive):
        began = time.perf_counter()
        query = replace(step.frame.query(localizer.bundle.grid), ranked=ranked)
        if prior_of is not None and number == 0:
            query = replace(query, prior=prior_of(_true(step.frame), np.random.default_rng(78)))
        answer: Answer | None = None
        try:
            frame = localizer.encode_and_search(query)
        except NoDepthError:
            track = track.broken()
        else:
            answer, track = follow(localizer, frame, track, step.T_previous_camera)
        yield answer, track, 1e3 * (time.perf_counter() - began)


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
        for column, (answer, track, _) in enumerate(answers_on(localizer, drive)):
            if answer is None:
                epoch[row, column] = track.epoch
                continue
            apart = answer.T_map_camera_guess[:2, 3] - _true(drive[column].frame)[:2, 3]
            accepted[row, column] = answer.status == "LOCALIZED"
            error_m[row, column] = float(np.hypot(*apart))
            epoch[row, column], frames[row, column] = answer.epoch, answer.frames
        report("tracks", row + 1, len(drives))
    return Tracks(accepted, error_m, epoch, frames)


def _true(frame: QueryFrame) -> Transform:
    if frame.T_map_camera is None:
        raise ValueError("the frame has no true pose")
    return frame.T_map_camera
