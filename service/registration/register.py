"""Register a query from several starts per hypothesis, in a coarse, a middle and a fine stage.

The best states of each hypothesis go on to the middle stage. The most promising of those go on to the fine stage.
"""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from service.geometry.rigid import Rotation, Transform, rotation_z, transform_from
from service.registration.kernel import STATE, TOLERANCE_M, QueryPoints, SolverOptions
from service.registration.points import GROUND_M
from service.registration.surfel_tiles import Cloud


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """A pose that registration starts from.

    Attributes:
        R_map_level: rotation from the query's level frame to the map frame.
        camera_m: position of the camera, map frame, m.
        hypothesis: number of the hypothesis that the start belongs to.
        similarity: similarity of the descriptors, known before registration.
    """

    R_map_level: Rotation
    camera_m: Float64[NDArray[np.float64], "3"]
    hypothesis: int
    similarity: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class RegistrationSettings:
    """Settings of registration, of November 2026, after the feasibility study.

    Attributes:
        offsets_m: offsets of the starts from each hypothesis, along and across its heading, m.
        turns_rad: extra yaw offsets at each position, rad. They are used only if the number of starts stays within ``most_starts``.
        most_starts: largest number of starts with extra yaw offsets.
        coarse_points: largest number of points in the coarse stage.
        kept: states that go on after the coarse stage, divided equally among the hypotheses. The few points of the coarse stage
            do not show which hypothesis is right, and hardly which start.
        kept_of_each: least and largest number of states to keep per hypothesis. These limits override ``kept``.
        middle_points: largest number of points in the middle stage.
        refined: largest number of states in the fine stage, over all hypotheses.
        similarity_weight: weight of the starts' similarity against the share of inliers, when the states for the fine stage are chosen.
        apart_m: least distance between two states that go on, m.
        fine_weight: least weight of a point in the fine stage. Dynamic objects mislead the search, so their points have less weight
            before. Near the right pose the robust kernel rejects objects that moved. Vehicles that stayed are the best measured
            surfaces (decision 0026).
        coarse: solver options of the coarse stage.
        middle: solver options of the middle stage.
        fine: solver options of the fine stage.
        tolerance_m: standard deviation of a point's distance to its surface in the score, m, apart from its noise. The coarse stage
            has 0.3 m instead.
        ground_m: points lower than this above the ground do not count in the score, m.
    """

    offsets_m: tuple[tuple[float, float], ...] = (
        (0.0, 0.0), (1.0, 0.0), (-1.0, 0.0), (2.2, 0.0), (-2.2, 0.0), (0.0, 1.2), (0.0, -1.2),
        (1.2, 1.2), (-1.2, 1.2), (1.2, -1.2), (-1.2, -1.2),
    )  # fmt: skip
    turns_rad: tuple[float, ...] = (0.12, -0.12)
    most_starts: int = 120
    coarse_points: int = 250
    kept: int = 24
    kept_of_each: tuple[int, int] = (2, 8)
    middle_points: int = 400
    refined: int = 10
    similarity_weight: float = 4.0
    apart_m: float = 0.5
    fine_weight: float = 1.0
    #: The coarse stage assumes rough surfaces. Otherwise near, well measured points, mostly on vehicles, would dominate the gradient.
    coarse: SolverOptions = field(
        default_factory=lambda: SolverOptions(
            iterations=6, reach=1.2, robust_first=0.8, robust_last=0.3, surface=0.1, prior_weight=0.02
        )
    )
    middle: SolverOptions = field(
        default_factory=lambda: SolverOptions(iterations=6, reach=1.2, robust_first=0.6, robust_last=0.1)
    )
    fine: SolverOptions = field(
        default_factory=lambda: SolverOptions(iterations=8, reach=1.2, robust_first=0.25, robust_last=0.06)
    )
    tolerance_m: float = TOLERANCE_M
    ground_m: float = GROUND_M


@dataclass(frozen=True, slots=True, eq=False)
class Registered:
    """A registered pose.

    Attributes:
        R_map_level: rotation from the query's level frame to the map frame.
        camera_m: position of the camera, map frame, m.
        scale: estimated factor from measured to true depth.
        offset: estimated disparity offset, px; 0 if no stereo rig is known.
        inliers: weighted share of the query's points that lie on the map, from 0 to 1.
        information: information matrix without the priors. Order: translation (m), rotation (rad), log scale, disparity offset (px).
        hypothesis: number of the hypothesis that the start belonged to.
        converged: whether the last step of the last stage was smaller than 1 mm and 0.1 degrees.
        iterations: solver steps of the last stage.
        error: half the sum of the weighted squared residuals before the last step, without the priors.
    """

    R_map_level: Rotation
    camera_m: Float64[NDArray[np.float64], "3"]
    scale: float
    offset: float
    inliers: float
    information: Float64[NDArray[np.float64], "8 8"]
    hypothesis: int
    converged: bool = False
    iterations: int = 0
    error: float = 0.0

    @property
    def T_map_level(self) -> Transform:
        """Pose of the query's level frame in the map frame."""
        return transform_from(self.R_map_level, self.camera_m)

    def of_frame(self, T_reference_level: Transform) -> "Registered":
        """Return the pose of another frame's level frame, if this pose is that of the reference.

        Args:
            T_reference_level: pose of the frame's level frame in the level frame of the reference.
        """
        R = self.R_map_level @ T_reference_level[:3, :3]
        return replace(self, R_map_level=R, camera_m=self.camera_m + self.R_map_level @ T_reference_level[:3, 3])


def register(
    cloud: Cloud, points: QueryPoints, starts: list[Start], height_m: float, settings: RegistrationSettings
) -> tuple[Registered, ...]:
    """Register a query from every start and return the refined poses, the largest share of inliers first.

    Args:
        cloud: cloud of the map.
        points: of the query, in its level frame.
        starts: at least one. If a hypothesis has several, the similarity of its last one counts.
        height_m: height of the camera above the ground, m.
        settings: of registration.
    """
    states, owner = _states(cloud, starts, settings)
    ground = settings.ground_m - height_m
    cloud.align(
        points.thinned(settings.coarse_points),
        states,
        settings.coarse,
        tolerance_m=0.3,
        height_min_m=ground,
    )
    kept = _best_of_each(states, owner, settings)
    best, owner = states[kept].copy(), owner[kept]
    cloud.align(
        points.thinned(settings.middle_points),
        best,
        settings.middle,
        tolerance_m=settings.tolerance_m,
        height_min_m=ground,
    )
    similar = {start.hypothesis: start.similarity for start in starts}
    similarity = np.array([similar[int(hypothesis)] for hypothesis in owner])
    promise = best["inliers"] + settings.similarity_weight * similarity
    kept = _distinct(best, promise, settings.refined, settings.apart_m)
    best, owner = best[kept].copy(), owner[kept]
    cloud.align(points.with_least_weight(settings.fine_weight), best, settings.fine)
    score(cloud, points, best, height_m, settings)
    order = np.argsort(-best["inliers"], kind="stable")
    return tuple(registered_of(best[k], int(owner[k]), cloud.origin_m) for k in order)


def score(
    cloud: Cloud, points: QueryPoints, states: NDArray[Any], height_m: float, settings: RegistrationSettings
) -> None:
    """Compute the share of inliers of every state at its present pose, in place.

    Args:
        cloud: cloud of the map.
        points: of the query, in its level frame.
        states: poses in the surfels' frame, (n,) of ``STATE``. Their field ``inliers`` is overwritten.
        height_m: height of the camera above the ground, m.
        settings: of registration.
    """
    score_only = replace(settings.fine, iterations=0)
    cloud.align(
        points,
        states,
        score_only,
        tolerance_m=settings.tolerance_m,
        height_min_m=settings.ground_m - height_m,
    )


def registered_of(state: Any, hypothesis: int, origin_m: Float64[NDArray[np.float64], "3"]) -> Registered:
    """Convert a state of the kernel to a pose in the map frame.

    Args:
        state: one ``STATE``, in the surfels' frame.
        hypothesis: number of the hypothesis that its start belonged to.
        origin_m: origin of the surfels' frame, map frame, m.
    """
    return Registered(
        state["R"].copy(),
        state["t"] + origin_m,
        float(np.exp(state["log_scale"])),
        float(state["offset"]),
        float(state["inliers"]),
        state["information"].copy(),
        hypothesis,
        bool(state["converged"]),
        int(state["iterations"]),
        float(state["error"]),
    )


def _states(cloud: Cloud, starts: list[Start], settings: RegistrationSettings) -> tuple[NDArray[Any], NDArray[np.intp]]:
    offsets = np.array([(along, across, 0.0) for along, across in settings.offsets_m])
    turned = len(starts) * len(offsets) * (1 + len(settings.turns_rad)) <= settings.most_starts
    turns = (0.0, *settings.turns_rad) if turned else (0.0,)
    states = np.zeros((len(starts), len(turns), len(offsets)), STATE)
    for rows, start in zip(states, starts, strict=True):
        rows["up"] = start.R_map_level[:, 2]
        rows["anchor"] = start.camera_m - cloud.origin_m
        rows["t"] = rows["anchor"] + offsets @ start.R_map_level.T
        for row, turn in zip(rows, turns, strict=True):
            row["R"] = start.R_map_level @ rotation_z(turn)
    owner = np.repeat([start.hypothesis for start in starts], len(turns) * len(offsets))
    return states.reshape(-1), owner


def _best_of_each(states: NDArray[Any], owner: NDArray[np.intp], settings: RegistrationSettings) -> list[int]:
    """Rows of the states with most inliers of each hypothesis, at least ``apart_m`` apart."""
    groups = [np.flatnonzero(owner == number) for number in np.unique(owner)]
    least, most = settings.kept_of_each
    each = min(max(settings.kept // len(groups), least), most)
    return [
        int(group[k])
        for group in groups
        for k in _distinct(states[group], states["inliers"][group], each, settings.apart_m)
    ]


def _distinct(states: NDArray[Any], promise: NDArray[np.float64], most: int, apart_m: float) -> list[int]:
    """Rows of the most promising states that are at least ``apart_m`` apart."""
    kept: list[int] = []
    for k in np.argsort(-promise, kind="stable"):
        if all(np.linalg.norm(states["t"][k] - states["t"][other]) >= apart_m for other in kept):
            kept.append(int(k))
            if len(kept) == most:
                break
    return kept
