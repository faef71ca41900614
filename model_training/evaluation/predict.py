"""Pass 1 of an evaluation: store the answers of a map to every query of a set. New measures then need no new run."""

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from model_training.datasets.dataset import Dataset, QueryFrame, Transforms
from model_training.evaluation.odometry import as_query
from service.confidence.features import FEATURES
from service.errors import DatasetError, NoDepthError
from service.geometry.rigid import Transform, heading_of_camera
from service.localization.answer import Answer
from service.localization.localizer import Localizer
from service.retrieval.prior import Prior
from service.retrieval.query import Query

#: Number of distinct places that are stored per answer.
RANKED = 10
#: Largest number of clusters and of registered poses that are stored per answer.
HYPOTHESES, CANDIDATES = 8, 4
#: Progress callback: stage, finished steps, all steps.
Report = Callable[[str, int, int], None]
#: Returns the prior of a robot, from the true T_map_camera (4, 4) and a random generator.
PriorOf = Callable[[Transform, np.random.Generator], Prior]
#: Returns the same query as another camera rig would take it.
SeenBy = Callable[[Query], Query]
T = TypeVar("T")
R = TypeVar("R")


@dataclass(frozen=True)
class Predictions:
    """Ground truth and answers of one query set, a row per query.

    Attributes:
        T_true: true T_map_camera (n, 4, 4).
        T_answer: T_map_camera of the answer, accepted or not; NaN without an answer (n, 4, 4).
        street_true: index of the street's feature at the true position, -1 for none (n,).
        street_answer: index of the answered street's feature, -1 for none (n,).
        ranked_xy: positions of the most similar distinct places, the best first, metres, map frame; NaN where there are fewer
            (n, RANKED, 2).
        ranked_place: indices of these places, -1 where there are fewer (n, RANKED).
        status: status of the answer; empty without an answer (n,).
        confidence: confidence of the answer; NaN if there is none (n,).
        evidence: confidence features in the order of ``FEATURES``; NaN if there are none (n, F).
        covariance: covariance of the answer; NaN if there is none (n, 6, 6).
        ms: duration of decoding and localizing, milliseconds (n,).
        stamp_s: timestamps of the ground truth, seconds (n,).
        hypotheses: x, y (metres, map frame), heading (radians) and weight of the clusters of the search, NaN where there are fewer
            (n, HYPOTHESES, 4). Files of early releases lack them; then all are NaN.
        candidates: x, y (metres, map frame), heading (radians) and support (nats) of the registered poses, the best first, NaN where
            there are fewer (n, CANDIDATES, 4). Files of early releases lack them; then all are NaN.
    """

    T_true: NDArray[np.float64]
    T_answer: NDArray[np.float64]
    street_true: NDArray[np.int64]
    street_answer: NDArray[np.int64]
    ranked_xy: NDArray[np.float64]
    ranked_place: NDArray[np.int64]
    status: NDArray[np.str_]
    confidence: NDArray[np.float64]
    evidence: NDArray[np.float64]
    covariance: NDArray[np.float64]
    ms: NDArray[np.float64]
    stamp_s: NDArray[np.float64]
    hypotheses: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, HYPOTHESES, 4)))
    candidates: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, CANDIDATES, 4)))

    def __post_init__(self) -> None:
        for name, kept in (("hypotheses", HYPOTHESES), ("candidates", CANDIDATES)):
            if len(getattr(self, name)) != len(self.T_true):  # the caller left the default
                object.__setattr__(self, name, np.full((len(self.T_true), kept, 4), np.nan))

    @property
    def localized(self) -> NDArray[np.bool_]:
        """Whether each answer was accepted (n,)."""
        return np.asarray(self.status == "LOCALIZED")

    def of(self, rows: NDArray[np.bool_]) -> "Predictions":
        """Return the predictions of some queries.

        Args:
            rows: True for the queries to keep (n,).
        """
        return Predictions(**{name: getattr(self, name)[rows] for name in self.__dataclass_fields__})

    def save(self, path: Path) -> None:
        """Write the predictions to an NPZ file, without pickle.

        Args:
            path: file to write.
        """
        part = path.with_suffix(".part.npz")
        np.savez_compressed(part, **{name: getattr(self, name) for name in self.__dataclass_fields__})
        part.rename(path)

    @staticmethod
    def load(path: Path) -> "Predictions":
        """Read a file that ``save`` wrote.

        Args:
            path: file to read.

        Raises:
            OSError: the file cannot be read.
            KeyError: a field is missing.
            BadZipFile: the file is not an NPZ file.
            ValueError: an array in it is damaged.
        """
        with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            return Predictions(
                **{
                    name: arrays[name]
                    for name in Predictions.__dataclass_fields__
                    if name in arrays or name not in _LATER
                }
            )


#: Fields that files of earlier releases lack.
_LATER = ("hypotheses", "candidates")


def joined(parts: list[Predictions]) -> Predictions:
    """Join the predictions of several query sets.

    Args:
        parts: predictions of each set.
    """
    return Predictions(
        **{name: np.concatenate([getattr(p, name) for p in parts]) for name in Predictions.__dataclass_fields__}
    )


def predict(
    localizer: Localizer,
    dataset: Dataset,
    name: str,
    *,
    refine: bool = True,
    workers: int = 2,
    frames_each: int = 1,
    prior_of: PriorOf | None = None,
    seen_by: SeenBy | None = None,
    report: Report = lambda *_: None,
) -> Predictions:
    """Localize every query of a set with ground truth.

    Args:
        localizer: the localizer of the map.
        dataset: the dataset with the queries.
        name: name of the query set.
        refine: register the answers. False answers by retrieval alone.
        workers: number of queries that are localized at the same time.
        frames_each: number of successive frames in one sequence query. It asks for the pose of its last frame and has noisy odometry.
        prior_of: returns the prior of each query; None for no prior.
        seen_by: changes each query to another camera rig; None keeps the rig.
        report: called after every query.

    Raises:
        DatasetError: the set has no ground truth or no frames.
    """
    frames = frames_with_truth(dataset, name)
    groups = [frames[k : k + frames_each] for k in range(0, len(frames), frames_each)]
    answers = answers_to(
        localizer, name, groups, refine=refine, workers=workers, prior_of=prior_of, seen_by=seen_by, report=report
    )
    return predictions_of(localizer, [group[-1] for group in groups], answers)


def frames_with_truth(dataset: Dataset, name: str) -> list[QueryFrame]:
    """Return the images of a query set.

    Args:
        dataset: the dataset.
        name: name of the query set.

    Raises:
        DatasetError: the set has no ground truth or no images.
    """
    frames = list(dataset.queries(name))
    if not frames or frames[0].T_map_camera is None:
        raise DatasetError(
            f"query set {name!r} of {dataset.folder} has no images or no poses.txt, so nothing can be measured; "
            "add the images and poses.txt (TUM format), or choose another query set",
            field="queries",
        )
    return frames


def answers_to(
    localizer: Localizer,
    name: str,
    groups: Sequence[list[QueryFrame]],
    odometry: Sequence[Transforms] | None = None,
    *,
    refine: bool = True,
    workers: int = 2,
    prior_of: PriorOf | None = None,
    seen_by: SeenBy | None = None,
    report: Report = lambda *_: None,
) -> list[tuple[Answer | None, float]]:
    """Localize groups of images, each group as one query. It asks for the pose of its last image.

    Args:
        localizer: the localizer of the map.
        name: name of the query set, for the report.
        groups: the images of each query, in the order of the traversal.
        odometry: T_odom_camera of the images of each query (k, 4, 4), metres; None for the true poses with errors.
        refine: register the answers. False answers by retrieval alone.
        workers: number of queries that are localized at the same time.
        prior_of: returns the prior of each query; None for no prior.
        seen_by: changes each query to another camera rig; None keeps the rig.
        report: called after every query.

    Returns:
        The answer to each query and its duration in milliseconds. The answer is None if an image has no depth.
    """

    def ask(number: int) -> tuple[Answer | None, float]:
        T_odom_camera = None if odometry is None else odometry[number]
        return _ask(localizer, groups[number], number, T_odom_camera, refine=refine, prior_of=prior_of, seen_by=seen_by)

    answers: list[tuple[Answer | None, float]] = []
    with ThreadPoolExecutor(workers) as pool:
        for done, answer in enumerate(in_order(pool, ask, range(len(groups)), ahead=4 * workers), 1):
            answers.append(answer)
            report(f"queries {name}", done, len(groups))
    return answers


def in_order(pool: ThreadPoolExecutor, work: Callable[[T], R], items: Iterable[T], *, ahead: int) -> Iterator[R]:
    """Yield the results in the order of the items, with at most ``ahead`` items in memory.

    Args:
        pool: threads that do the work.
        work: function of one item.
        items: the items.
        ahead: largest number of items that are submitted at a time.
    """
    rest = iter(items)
    waiting = [pool.submit(work, item) for item in islice(rest, ahead)]
    while waiting:
        yield waiting.pop(0).result()
        waiting += [pool.submit(work, item) for item in islice(rest, 1)]


def _ask(
    localizer: Localizer,
    frames: list[QueryFrame],
    number: int,
    T_odom_camera: Transforms | None,
    *,
    refine: bool,
    prior_of: PriorOf | None,
    seen_by: SeenBy | None,
) -> tuple[Answer | None, float]:
    began = time.perf_counter()
    queries, poses = as_query(
        frames,
        np.random.default_rng([77, number]),
        grid=localizer.bundle.grid,
        ranked=RANKED,
        refine=refine,
        T_odom_camera=T_odom_camera,
    )
    T_map_camera = frames[-1].T_map_camera
    if prior_of is not None and T_map_camera is not None:
        prior = prior_of(T_map_camera, np.random.default_rng([78, number]))
        queries = (replace(queries[0], prior=prior), *queries[1:])
    if seen_by is not None:
        queries = tuple(seen_by(query) for query in queries)
    try:
        answer: Answer | None = localizer.localize_frames(queries, poses)
    except NoDepthError:
        answer = None
    return answer, 1e3 * (time.perf_counter() - began)


def predictions_of(
    localizer: Localizer, frames: Sequence[QueryFrame], answers: Sequence[tuple[Answer | None, float]]
) -> Predictions:
    """Return answers beside their ground truth.

    Args:
        localizer: the localizer of the map.
        frames: the image whose pose each query asks for, with its true pose.
        answers: the answer to each query, None without depth, and its duration in milliseconds.
    """
    count, streets = len(frames), localizer.bundle.streets
    T_true = np.array([frame.T_map_camera for frame in frames])
    T_answer, ranked = np.full((count, 4, 4), np.nan), np.full((count, RANKED, 2), np.nan)
    ranked_place = np.full((count, RANKED), -1)
    street_answer, status = np.full(count, -1), np.full(count, "", "<U10")
    confidence, evidence = np.full(count, np.nan), np.full((count, len(FEATURES)), np.nan)
    covariance = np.full((count, 6, 6), np.nan)
    hypotheses, candidates = np.full((count, HYPOTHESES, 4), np.nan), np.full((count, CANDIDATES, 4), np.nan)
    for k, (answer, _) in enumerate(answers):
        if answer is None:
            continue
        T_answer[k] = answer.T_map_camera_guess
        status[k] = answer.status
        if answer.confidence is not None:
            confidence[k] = answer.confidence
        if answer.evidence is not None:
            evidence[k] = answer.evidence
        if answer.covariance is not None:
            covariance[k] = answer.covariance
        for j, neighbour in enumerate(answer.neighbours[:RANKED]):
            ranked[k, j], ranked_place[k, j] = neighbour.position_m[:2], neighbour.place
        for j, cluster in enumerate(answer.hypotheses[:HYPOTHESES]):
            hypotheses[k, j] = *cluster.position_m[:2], cluster.heading_rad, cluster.weight
        for j, candidate in enumerate((answer.candidates or ())[:CANDIDATES]):
            T = candidate.T_map_camera
            candidates[k, j] = *T[:2, 3], heading_of_camera(T), candidate.support
        street_answer[k] = answer.street
    street_true = np.full(count, -1)
    if streets is not None:
        street_true = np.array([streets.index_at(T[:2, 3]) for T in T_true])
    return Predictions(
        T_true,
        T_answer,
        street_true,
        street_answer,
        ranked,
        ranked_place,
        status,
        confidence,
        evidence,
        covariance,
        np.array([ms for _, ms in answers]),
        np.array([frame.stamp_s for frame in frames], np.float64),
        hypotheses,
        candidates,
    )


def headings_of(transforms: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the heading of each camera, radians, map frame (n,).

    Args:
        transforms: T_map_camera (n, 4, 4).
    """
    return np.array([heading_of_camera(T) for T in transforms])
