"""Several starts for every hypothesis, coarse first, the best few to the end; the best supported one is the answer."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from service.geometry.rigid import Rotation
from service.registration.kernel import STATE, QueryPoints, SolverOptions, align
from service.registration.surfel_map import SurfelMap


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """Where a query may have been taken: level frame in the map; ``hypothesis`` says whose start it is."""

    R_map_level: Rotation
    camera_m: Float64[NDArray[np.float64], "3"]
    hypothesis: int


@dataclass(frozen=True, slots=True, kw_only=True)
class RegistrationSettings:
    """Ours, November 2026, after feasibility.md.

    Attributes:
        offsets_m: of the starts from each hypothesis, along and across its heading.
        coarse_points: so many of the points take part in the coarse stage.
        refined: starts that are carried to the end.
        apart_m: two of them stand at least this far apart.
    """

    offsets_m: tuple[tuple[float, float], ...] = ((0.0, 0.0), (1.8, 0.0), (-1.8, 0.0), (0.0, 1.2), (0.0, -1.2))
    coarse_points: int = 300
    refined: int = 3
    apart_m: float = 0.5
    #: Coarse: surfaces are rough, or what is near and well measured, mostly vehicles, would pull everything its way.
    coarse: SolverOptions = field(
        default_factory=lambda: SolverOptions(
            iterations=8, reach=2.7, robust_first=2.0, robust_last=0.5, surface=0.2, prior_weight=0.02
        )
    )
    fine: SolverOptions = field(
        default_factory=lambda: SolverOptions(iterations=15, reach=1.2, robust_first=0.6, robust_last=0.06)
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
        inliers: share of the query's weight that lies on the map.
        information: 8 x 8 of translation, rotation, log scale, disparity offset; without the priors.
        hypothesis: whose start it was.
    """

    R_map_level: Rotation
    camera_m: Float64[NDArray[np.float64], "3"]
    scale: float
    inliers: float
    information: Float64[NDArray[np.float64], "8 8"]
    hypothesis: int


def register(
    cloud: SurfelMap, points: QueryPoints, starts: list[Start], height_m: float, settings: RegistrationSettings
) -> tuple[Registered, ...]:
    """Register a query from every start; the best supported comes first."""
    states, owner = _states(cloud, starts, settings)
    few = points.subset(np.linspace(0, len(points) - 1, min(settings.coarse_points, len(points))).astype(np.intp))
    ground = settings.ground_m - height_m
    align(cloud.coarse, cloud.surfels, few, states, settings.coarse, tolerance_m=0.3, height_min_m=ground)
    kept = _distinct(states, settings)
    best, owner = states[kept].copy(), owner[kept]
    align(cloud.fine, cloud.surfels, points, best, settings.fine, tolerance_m=settings.tolerance_m, height_min_m=ground)
    order = np.argsort(-best["inliers"], kind="stable")
    return tuple(_registered(best[k], int(owner[k]), cloud.origin_m) for k in order)


def _registered(state: Any, hypothesis: int, origin_m: Float64[NDArray[np.float64], "3"]) -> Registered:
    return Registered(
        state["R"].copy(), state["t"] + origin_m, float(np.exp(state["log_scale"])), float(state["inliers"]),
        state["information"].copy(), hypothesis,
    )  # fmt: skip


def _states(
    cloud: SurfelMap, starts: list[Start], settings: RegistrationSettings
) -> tuple[NDArray[Any], NDArray[np.intp]]:
    offsets = np.array([(along, across, 0.0) for along, across in settings.offsets_m])
    states = np.zeros((len(starts), len(offsets)), STATE)
    for row, start in zip(states, starts, strict=True):
        row["R"], row["up"] = start.R_map_level, start.R_map_level[:, 2]
        row["anchor"] = start.camera_m - cloud.origin_m
        row["t"] = row["anchor"] + offsets @ start.R_map_level.T
    owner = np.repeat([start.hypothesis for start in starts], len(offsets))
    return states.reshape(-1), owner


def _distinct(states: NDArray[Any], settings: RegistrationSettings) -> list[int]:
    """The best supported states that stand apart."""
    kept: list[int] = []
    for k in np.argsort(-states["inliers"], kind="stable"):
        if all(np.linalg.norm(states["t"][k] - states["t"][other]) >= settings.apart_m for other in kept):
            kept.append(int(k))
            if len(kept) == settings.refined:
                break
    return kept
