"""Find the stage that loses a query: compare each stage of localization with the ground truth, in the order of execution.

``failures`` derives the cause from stored answers. This module localizes again and inspects each stage. So it needs the map and the
images.
"""

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from typing import Any

import numpy as np

from model_training.datasets.dataset import Dataset, QueryFrame
from model_training.evaluation.measures import RIGHT_PLACE_M
from service.errors import DatasetError, NoDepthError
from service.geometry.rigid import Rotation, Transform, heading_of_camera, wrap_angle
from service.localization.answer import Answer
from service.localization.localizer import Localizer
from service.localization.refine import settings_for_rig
from service.maps.calibration import RIGHT_M
from service.registration.kernel import STATE, QueryPoints
from service.registration.register import RegistrationSettings, Start, register, registered_of, score
from service.registration.surfel_tiles import Cloud
from service.retrieval.knn import distinct_places
from service.retrieval.retrieve import RANKED, EncodedFrame
from service.retrieval.starts import starts_from
from service.scoring.measured import measure, merged_points

#: Largest error of a right level. Registration starts from it and corrects about this much.
TILT_DEG, HEIGHT_M = 3.0, 0.5
#: Largest error of a start from which registration can reach the true pose.
START_M, START_DEG = 4.0, 30.0
#: Largest heading error of a right candidate, degrees.
HEADING_DEG = 10.0

#: Share of inliers that an exact noise model gives to points with a map surface in reach. A point counts by exp(-x^2 / 2), where x is its
#: distance to the surface in standard deviations. The mean of this weight over the normal distribution is 1 / sqrt(2).
EXACT_INLIERS = 1 / np.sqrt(2)
#: Tolerance, metres, at which every point with a map surface in reach counts fully.
_ANY_DISTANCE_M = 1e6

#: Progress callback: stage, finished steps, all steps.
Report = Callable[[str, int, int], None]


class Lost(StrEnum):
    """The first stage that lost a query; ``NOT`` if the answer is right and accepted. ``MEANING`` explains each."""

    NOT = "-"
    LEVEL = "level"
    RETRIEVAL = "retrieval"
    CANDIDATES = "candidates"
    REGISTRATION = "registration"
    CHOICE = "choice"
    STATUS = "status"


#: Explanation of each stage for the report.
MEANING = {
    Lost.NOT: "the answer is within 1 m and accepted",
    Lost.LEVEL: f"the estimated tilt is off by more than {TILT_DEG:g} degrees, or the height by more than {HEIGHT_M:g} m",
    Lost.RETRIEVAL: f"no initial pose is within {START_M:g} m and {START_DEG:g} degrees of the truth",
    Lost.CANDIDATES: "no registered pose is within 1 m, although registration from the true pose stays there",
    Lost.REGISTRATION: "registration leaves even the true pose by more than 1 m",
    Lost.CHOICE: "a registered pose is within 1 m, but another one was chosen",
    Lost.STATUS: "the chosen pose is within 1 m, but the status is not LOCALIZED",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class QueryStages:
    """The comparison of one query with its ground truth, stage by stage.

    Distances are in metres on the ground. They are infinite if the stage has no result.

    Attributes:
        number: number of the query in its set.
        tilt_deg: angle between the estimated vertical and the normal of the map's ground, degrees.
        height_error_m: estimated minus true height of the camera above the ground, metres.
        rank: rank of the first retrieved place within 5 m, from 1; 0 if there is none.
        start_m: distance of the nearest start with about the right heading.
        candidate_m: distance of the nearest registered pose with about the right heading.
        from_truth_m: distance between the true pose and the result of a registration that starts there.
        inliers_at_truth: share of inliers at the true pose, of the points that the service registers.
        inliers_predicted: share of inliers that the noise model predicts there: ``EXACT_INLIERS`` of the points with a map surface in
            reach. Points without one are no inliers at any pose.
        inliers_from_truth: share of inliers at the result of the registration from the true pose.
        error_m: distance of the answer from the true position, whatever its status.
        heading_error_deg: heading error of the answer, 0 to 180 degrees.
        status: status of the answer; empty if the images were refused.
        confidence: confidence of the answer; NaN if there is none.
        noise: estimated standard deviation of inverse depth, 1/m.
        lost: the first stage that lost the query.
    """

    number: int
    tilt_deg: float = np.inf
    height_error_m: float = np.inf
    rank: int = 0
    start_m: float = np.inf
    candidate_m: float = np.inf
    from_truth_m: float = np.inf
    inliers_at_truth: float = np.nan
    inliers_predicted: float = np.nan
    inliers_from_truth: float = np.nan
    error_m: float = np.inf
    heading_error_deg: float = np.nan
    status: str = ""
    confidence: float = np.nan
    noise: float = np.nan
    lost: Lost = Lost.LEVEL

    def as_json(self) -> dict[str, Any]:
        """Return the fields as JSON values; None for a number that is not finite."""
        return {
            name: None if isinstance(value, float) and not np.isfinite(value) else value
            for name, value in asdict(self).items()
        }


def stages_of(
    localizer: Localizer, dataset: Dataset, name: str, *, report: Report = lambda *_: None
) -> list[QueryStages]:
    """Localize every query of a set and compare each stage with the ground truth.

    Args:
        localizer: the localizer of the map.
        dataset: the dataset with the queries.
        name: name of the query set.
        report: called after every query.

    Raises:
        DatasetError: the set has no ground truth, or the map has no cloud for registration.
    """
    if localizer.bundle.cloud is None:
        raise DatasetError(
            f"the map {localizer.bundle.name} has no cloud, so there are no stages to compare", field="bundle"
        )
    frames = list(dataset.queries(name))
    found = []
    for done, frame in enumerate(frames, 1):
        if frame.T_map_camera is None:
            raise DatasetError(
                f"query set {name!r} of {dataset.folder} has no poses.txt, so nothing can be compared", field="queries"
            )
        found.append(_stages(localizer, localizer.bundle.cloud, frame, frame.T_map_camera))
        report(f"stages {name}", done, len(frames))
    return found


def _stages(localizer: Localizer, cloud: Cloud, asked: QueryFrame, truth: Transform) -> QueryStages:
    try:
        frame = localizer.encode_and_search(asked.query(localizer.bundle.grid))
    except NoDepthError:
        return QueryStages(number=asked.number)
    answer, bundle = localizer.answer((frame,)), localizer.bundle
    heading, T_answer = heading_of_camera(truth), answer.T_map_camera_guess
    tilt_deg, height_error_m = _level_errors(localizer, frame, truth)
    starts = starts_from(
        (frame,), None, lidar_height_m=bundle.manifest.lidar_height_m, settings=localizer.refining.starts
    )
    retrieved = distinct_places(frame.matches, RANKED)
    away_m = [float(np.hypot(*(place.position_m[:2] - truth[:2, 3]))) for place in retrieved]
    near = [rank for rank, away in enumerate(away_m, 1) if away <= RIGHT_PLACE_M]
    from_truth_m, at_truth, predicted, from_truth = _from_truth(localizer, cloud, frame, truth)
    found = QueryStages(
        number=asked.number,
        tilt_deg=tilt_deg,
        height_error_m=height_error_m,
        rank=near[0] if near else 0,
        start_m=_nearest(((s.R_map_level, s.camera_m) for s in starts), truth, heading, START_DEG),
        candidate_m=_nearest(_candidates(answer, frame), truth, heading, HEADING_DEG),
        from_truth_m=from_truth_m,
        inliers_at_truth=at_truth,
        inliers_predicted=predicted,
        inliers_from_truth=from_truth,
        error_m=float(np.hypot(*(T_answer[:2, 3] - truth[:2, 3]))),
        heading_error_deg=abs(float(np.rad2deg(wrap_angle(heading_of_camera(T_answer) - heading)))),
        status=answer.status,
        confidence=np.nan if answer.confidence is None else answer.confidence,
        noise=frame.noise,
    )
    return replace(found, lost=loses(found))


def lost_by_stage(found: list[QueryStages]) -> dict[Lost, int]:
    """Count the queries that each stage lost, in the order of the stages. The right and accepted queries come first.

    Args:
        found: the comparison of each query.
    """
    return {stage: sum(each.lost == stage for each in found) for stage in Lost}


def loses(found: QueryStages) -> Lost:
    """Return the first stage that lost a query.

    Args:
        found: the comparison of the query. Its own ``lost`` is ignored.
    """
    if found.error_m <= RIGHT_M:
        return Lost.NOT if found.status == "LOCALIZED" else Lost.STATUS
    if found.tilt_deg > TILT_DEG or abs(found.height_error_m) > HEIGHT_M:
        return Lost.LEVEL
    if found.candidate_m <= RIGHT_M:
        return Lost.CHOICE
    if found.start_m > START_M:
        return Lost.RETRIEVAL
    return Lost.REGISTRATION if found.from_truth_m > RIGHT_M else Lost.CANDIDATES


def _level_errors(localizer: Localizer, frame: EncodedFrame, truth: Transform) -> tuple[float, float]:
    """Return the angle between the estimated vertical and the map's (degrees), and the error of the camera height (metres)."""
    bundle = localizer.bundle
    nearest = int(np.argmin(np.linalg.norm(bundle.T_map_place[:, :2, 3] - truth[:2, 3], axis=1)))
    place = np.array(bundle.T_map_place[nearest])
    up = truth[:3, :3] @ frame.R_level_camera[2]
    tilt = np.arccos(np.clip(up @ place[:3, 2], -1, 1))
    true_height_m = float((truth[:3, 3] - place[:3, 3]) @ place[:3, 2]) + bundle.manifest.lidar_height_m
    return float(np.rad2deg(tilt)), float(frame.views.height_m - true_height_m)


def _candidates(answer: Answer, frame: EncodedFrame) -> Iterator[tuple[Rotation, np.ndarray]]:
    for candidate in answer.candidates or ():
        T = frame.pose_of_level(candidate.T_map_camera)
        yield T[:3, :3], T[:3, 3]


def _nearest(poses: Iterator[tuple[Rotation, np.ndarray]], truth: Transform, heading: float, most_deg: float) -> float:
    """Return the distance of the nearest level pose with about the right heading, metres; infinite if there is none."""
    away = [
        float(np.hypot(*(at[:2] - truth[:2, 3])))
        for R, at in poses
        if abs(np.rad2deg(wrap_angle(float(np.arctan2(R[1, 0], R[0, 0])) - heading))) <= most_deg
    ]
    return min(away, default=np.inf)


def _from_truth(
    localizer: Localizer, cloud: Cloud, frame: EncodedFrame, truth: Transform
) -> tuple[float, float, float, float]:
    """Register the points of the service from the true pose.

    Returns:
        The distance that the pose moves (metres), and three shares of inliers: before, as the noise model predicts before, and after.
    """
    settings = localizer.refining
    rig_px_m = frame.query.focal_baseline_px_m
    if rig_px_m is not None:
        settings = settings_for_rig(settings, rig_px_m)
    measured = measure(
        (frame,),
        settings.points,
        focal_baseline_px_m=settings.focal_baseline_px_m,
        is_rig=rig_px_m is not None,
        surveyed_height_m=localizer.bundle.manifest.surveyed_height_m,
    )
    points = merged_points(measured)
    if len(points) < settings.fewest_points:
        return np.inf, np.nan, np.nan, np.nan
    start = Start(frame.pose_of_level(truth)[:3, :3], truth[:3, 3], 0)
    best = register(cloud, points, [start], frame.views.height_m, settings.registration)[0]
    at_truth = _inliers(cloud, points, start, frame.views.height_m, settings.registration)
    any_distance = replace(settings.registration, tolerance_m=_ANY_DISTANCE_M)
    predicted = float(EXACT_INLIERS) * _inliers(cloud, points, start, frame.views.height_m, any_distance)
    T_map_camera = frame.pose_of_camera(best.T_map_level)
    return float(np.hypot(*(T_map_camera[:2, 3] - truth[:2, 3]))), at_truth, predicted, best.inliers


def _inliers(cloud: Cloud, points: QueryPoints, at: Start, height_m: float, settings: RegistrationSettings) -> float:
    state = np.zeros(1, STATE)
    state["R"], state["up"] = at.R_map_level, at.R_map_level[:, 2]
    state["t"] = state["anchor"] = at.camera_m - cloud.origin_m
    score(cloud, points, state, height_m, settings)
    return registered_of(state[0], 0, cloud.origin_m).inliers
