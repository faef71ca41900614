"""Several starts for every hypothesis, coarse first; the best of each hypothesis goes on, the best few of those to the end."""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from service.geometry.rigid import Rotation, rotation_z
from service.registration.kernel import STATE, QueryPoints, SolverOptions, align
from service.registration.surfel_map import SurfelMap


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """Where a query may have been taken: level frame in the map; ``hypothesis`` says whose start it is.

    ``similarity`` is what spoke for it before any registration.
    """

    R_map_level: Rotation
    camera_m: Float64[NDArray[np.float64], "3"]
    hypothesis: int
    similarity: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class RegistrationSettings:
    """Ours, November 2026, after feasibility.md.

    Attributes:
        offsets_m: of the starts from each hypothesis, along and across its heading.
        turns_rad: of further starts at every offset, where hypotheses are few enough;
        most_starts: that is, if no more than this come of it.
        coarse_points: so many of the points take part in the coarse stage, from every start;
        kept: states that go on, as many of each hypothesis, ``kept_of_each`` at the least and at the most; the few points of
            the coarse stage do not tell which hypothesis is right, and hardly which start.
        middle_points: so many of the points take part in the middle stage.
        refined: of those that are carried to the end, over all hypotheses;
        similarity_weight: of the starts' similarity against the share of inliers, when these are chosen.
        apart_m: two of them stand at least this far apart.
        fine_weight: no point weighs less at the end. What may have moved misleads the search, but near the right pose the
            robust kernel knows what did move, and vehicles that stayed are the best measured surfaces there are.
    """

    offsets_m: tuple[tuple[float, float], ...] = ((0.0, 0.0), (1.8, 0.0), (-1.8, 0.0), (0.0, 1.2), (0.0, -1.2))
    turns_rad: tuple[float, ...] = (0.12, -0.12)
    most_starts: int = 60
    coarse_points: int = 250
    kept: int = 16
    kept_of_each: tuple[int, int] = (2, 5)
    middle_points: int = 400
    refined: int = 6
    similarity_weight: float = 4.0
    apart_m: float = 0.5
    fine_weight: float = 1.0
    #: Surfaces count as rough at first, or what is near and well measured, mostly vehicles, would pull everything its way.
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
    tolerance_m: float = 0.1
    ground_m: float = 0.3


@dataclass(frozen=True, slots=True, eq=False)
class Registered:
    """One refined start.

    Attributes:
        R_map_level: level frame of the query in the map.
        camera_m: of the camera, map frame.
        scale: the depth's own scale error, estimated.
        offset: of the disparity, px, estimated; 0 where no rig is known.
        inliers: share of the query's weight that lies on the map.
        information: 8 x 8 of translation, rotation, log scale, disparity offset; without the priors.
        hypothesis: whose start it was.
    """

    R_map_level: Rotation
    camera_m: Float64[NDArray[np.float64], "3"]
    scale: float
    offset: float
    inliers: float
    information: Float64[NDArray[np.float64], "8 8"]
    hypothesis: int


def register(
    cloud: SurfelMap, points: QueryPoints, starts: list[Start], height_m: float, settings: RegistrationSettings
) -> tuple[Registered, ...]:
    """Register a query from every start; the best supported comes first."""
    states, owner = _states(cloud, starts, settings)
    ground = settings.ground_m - height_m
    align(
        cloud.grid, cloud.surfels, points.thinned(settings.coarse_points), states, settings.coarse, tolerance_m=0.3,
        height_min_m=ground,
    )  # fmt: skip
    kept = _best_of_each(states, owner, settings)
    best, owner = states[kept].copy(), owner[kept]
    align(
        cloud.grid, cloud.surfels, points.thinned(settings.middle_points), best, settings.middle,
        tolerance_m=settings.tolerance_m, height_min_m=ground,
    )  # fmt: skip
    similar = {start.hypothesis: start.similarity for start in starts}
    similarity = np.array([similar[int(hypothesis)] for hypothesis in owner])
    promise = best["inliers"] + settings.similarity_weight * similarity
    kept = _distinct(best, promise, settings.refined, settings.apart_m)
    best, owner = best[kept].copy(), owner[kept]
    align(cloud.grid, cloud.surfels, points.weighing_at_least(settings.fine_weight), best, settings.fine)
    score(cloud, points, best, height_m, settings)
    order = np.argsort(-best["inliers"], kind="stable")
    return tuple(registered_of(best[k], int(owner[k]), cloud.origin_m) for k in order)


def score(
    cloud: SurfelMap, points: QueryPoints, states: NDArray[Any], height_m: float, settings: RegistrationSettings
) -> None:
    """Tell every state (``STATE``, in place) its share of inliers where it stands."""
    score_only = replace(settings.fine, iterations=0)
    align(
        cloud.grid, cloud.surfels, points, states, score_only, tolerance_m=settings.tolerance_m,
        height_min_m=settings.ground_m - height_m,
    )  # fmt: skip


def registered_of(state: Any, hypothesis: int, origin_m: Float64[NDArray[np.float64], "3"]) -> Registered:
    """A state of the kernel (``STATE``) as a pose in the map frame."""
    return Registered(
        state["R"].copy(), state["t"] + origin_m, float(np.exp(state["log_scale"])), float(state["offset"]), float(state["inliers"]),
        state["information"].copy(), hypothesis,
    )  # fmt: skip


def _states(
    cloud: SurfelMap, starts: list[Start], settings: RegistrationSettings
) -> tuple[NDArray[Any], NDArray[np.intp]]:
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
    """The best supported states of each hypothesis that stand apart."""
    groups = [np.flatnonzero(owner == number) for number in np.unique(owner)]
    least, most = settings.kept_of_each
    each = min(max(settings.kept // len(groups), least), most)
    return [
        int(group[k])
        for group in groups
        for k in _distinct(states[group], states["inliers"][group], each, settings.apart_m)
    ]


def _distinct(states: NDArray[Any], promise: NDArray[np.float64], most: int, apart_m: float) -> list[int]:
    """The most promising states that stand apart."""
    kept: list[int] = []
    for k in np.argsort(-promise, kind="stable"):
        if all(np.linalg.norm(states["t"][k] - states["t"][other]) >= apart_m for other in kept):
            kept.append(int(k))
            if len(kept) == most:
                break
    return kept
