"""How the images of a query set become queries: alone, several in one query, as one moving robot, with a prior or without."""

from typing import ClassVar, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from model_training.datasets.dataset import ODOMETRY_FILE, Dataset, QueryFrame, Transforms, query_folder
from model_training.evaluation.predict import RANKED, Predictions, Report, answers_to, frames_with_truth, predictions_of
from model_training.evaluation.priors import prior_with_std
from model_training.evaluation.tracks import answers_on, steps_of
from service.errors import DatasetError
from service.localization.localizer import Localizer

#: Largest number of images in one query, as in the service's contract.
MOST_FRAMES = 16
#: Where the relative poses of the images come from.
OdometrySource = Literal["odometry.txt", "ground truth, with simulated errors"]


class QueryMode(BaseModel):
    """How the images of a query set become queries.

    Attributes:
        frames: consecutive images in one query. There is one query for each image that has enough images before it.
        prior_std_m: standard deviation of a prior per axis, and of its error from the true position, metres; None for no prior.
        track: the images are those of one moving robot. Each answer uses the images before. Only the first image has a prior.
    """

    model_config: ClassVar[ConfigDict] = ConfigDict(frozen=True, extra="forbid")

    frames: int = Field(1, ge=1, le=MOST_FRAMES)
    prior_std_m: float | None = Field(None, gt=0)
    track: bool = False

    def described(self) -> str:
        """Return the mode as text for readers."""
        asked = "single images"
        if self.frames > 1:
            asked = f"{self.frames} consecutive images in one query"
        if self.track:
            asked = "the images as one moving robot (track)"
        if self.prior_std_m is None:
            return asked
        return f"{asked}, prior of {self.prior_std_m:g} m" + (" for the first image" if self.track else "")


SINGLE = QueryMode()


def predict_in_mode(
    localizer: Localizer,
    dataset: Dataset,
    name: str,
    mode: QueryMode,
    *,
    refine: bool = True,
    workers: int = 2,
    report: Report = lambda *_: None,
) -> tuple[Predictions, OdometrySource | None]:
    """Localize the images of a set in a mode.

    Args:
        localizer: the localizer of the map.
        dataset: the dataset with the queries.
        name: name of the query set.
        mode: how the images become queries.
        refine: register the answers. False answers by retrieval alone.
        workers: number of queries that are localized at the same time. The images of a track follow one another.
        report: called after every query.

    Returns:
        The answers, a row for each query with the pose of its last image; and where relative poses come from. None: there are none.

    Raises:
        DatasetError: the set has no ground truth or too few images, or its odometry lacks a line.
    """
    frames = frames_with_truth(dataset, name)
    prior_of = None if mode.prior_std_m is None else prior_with_std(mode.prior_std_m)
    if len(frames) < mode.frames:
        raise DatasetError(
            f"--frames {mode.frames}: query set {name!r} of {dataset.folder} has {len(frames)} images; give at most this number",
            field="frames",
        )
    T_odom_camera = _odometry(dataset, name, frames) if mode.track or mode.frames > 1 else None
    source: OdometrySource = "ground truth, with simulated errors" if T_odom_camera is None else "odometry.txt"
    if mode.track:
        steps = steps_of(frames, np.random.default_rng(79), T_odom_camera)
        answers = []
        for answer, _, ms in answers_on(localizer, steps, ranked=RANKED, prior_of=prior_of):
            answers.append((answer, ms))
            report(f"queries {name}", len(answers), len(frames))
        return predictions_of(localizer, frames, answers), source
    ends = range(mode.frames, len(frames) + 1)
    groups = [frames[end - mode.frames : end] for end in ends]
    odometry = None if T_odom_camera is None else [T_odom_camera[end - mode.frames : end] for end in ends]
    answers = answers_to(
        localizer, name, groups, odometry, refine=refine, workers=workers, prior_of=prior_of, report=report
    )
    return predictions_of(localizer, [group[-1] for group in groups], answers), source if mode.frames > 1 else None


def _odometry(dataset: Dataset, name: str, frames: list[QueryFrame]) -> Transforms | None:
    """Return T_odom_camera of the images (n, 4, 4); None if the set has no odometry."""
    odometry = dataset.odometry(name)
    if odometry is None:
        return None
    if frames[-1].number >= len(odometry):
        path = query_folder(dataset.folder, name) / ODOMETRY_FILE
        raise DatasetError(
            f"{path} has {len(odometry)} lines, none for {frames[-1].rgb_path.name}; write a line per image",
            field=ODOMETRY_FILE,
        )
    return odometry[[frame.number for frame in frames]]
