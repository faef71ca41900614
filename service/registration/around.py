"""Other poses near a registered one that the points fit as well: noise makes a hollow of its own wherever it happens to agree.

A search that starts metres apart ends in whichever hollow it meets first. So the answer's surroundings are searched once more, densely,
and what cannot have moved says which of the poses found there are worth a closer look.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from service.geometry.rigid import rotation_z
from service.registration.kernel import STATE, QueryPoints, align
from service.registration.register import Registered, RegistrationSettings, registered_of, score
from service.registration.surfel_map import SurfelMap


@dataclass(frozen=True, slots=True, kw_only=True)
class AroundSettings:
    """Ours, November 2026; chosen on a watch city.

    Attributes:
        from_noise: of an inverse depth, 1/m, independent from pixel to pixel; of less noisy pictures 2 % move, so it is not worth the
            time. What near pixels share, as in stereo matching, makes no such hollows: of KITTI's pairs it would move right poses away.
        offsets: of the starts from the pose: along and across its heading, m, and turned, rad.
        points: so many take part.
        kept: poses that are worth a closer look, at most.
        apart_m: two of them, or one and the pose itself, differ by this at least, turns counting by
        arm_m: what a turn moves.
    """

    from_noise: float = 1.2e-3
    offsets: tuple[tuple[float, float, float], ...] = (
        (0.0, 0.0, 0.0), (1.4, 0.0, 0.0), (-1.4, 0.0, 0.0), (0.0, 0.8, 0.0), (0.0, -0.8, 0.0),
        (0.0, 0.8, 0.09), (0.0, -0.8, -0.09), (0.0, 0.8, -0.09), (0.0, -0.8, 0.09),
    )  # fmt: skip
    points: int = 1500
    kept: int = 3
    apart_m: float = 0.25
    arm_m: float = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class Near:
    """A pose, and the share of inliers among the points of what cannot have moved."""

    pose: Registered
    still: float


def poses_around(
    cloud: SurfelMap, points: QueryPoints, found: Registered, height_m: float, settings: RegistrationSettings, around: AroundSettings
) -> list[Near]:  # fmt: skip
    """The pose itself, and the best of those around it that are another.

    Args:
        cloud: the map's.
        points: of the query, its level frame.
        found: the pose.
        height_m: of the camera above the ground.
        settings: as it was registered with.
        around: where to search.
    """
    states = np.zeros(1 + len(around.offsets), STATE)
    states["R"], states["t"] = found.R_map_level, found.camera_m - cloud.origin_m
    states["log_scale"], states["offset"] = np.log(found.scale), found.offset
    for state, (along, across, turn) in zip(states[1:], around.offsets, strict=True):
        state["R"] = found.R_map_level @ rotation_z(turn)
        state["t"] += found.R_map_level @ [along, across, 0.0]
    states["anchor"], states["up"] = states["t"], found.R_map_level[:, 2]
    align(cloud.grid, cloud.surfels, points.thinned(around.points), states[1:], settings.fine)
    score(cloud, points, states, height_m, settings)
    alone = states.copy()
    score(cloud, points.subset(np.flatnonzero(points.weight == points.weight.max())), alone, height_m, settings)
    still: Float64[NDArray[np.float64], " n"] = alone["inliers"]
    kept = _distinct(states, still, around)
    near = [Near(registered_of(states[k], found.hypothesis, cloud.origin_m), float(still[k])) for k in kept]
    return [replace(near[0], pose=found), *near[1:]]


def _distinct(states: NDArray[Any], still: Float64[NDArray[np.float64], " n"], around: AroundSettings) -> list[int]:
    """The first state, and as many others as are kept, those with the largest share first."""
    heading = np.unwrap(np.arctan2(states["R"][:, 1, 0], states["R"][:, 0, 0]))
    at = np.c_[states["t"], around.arm_m * heading]
    kept = [0]
    for k in 1 + np.argsort(-still[1:], kind="stable"):
        if np.linalg.norm(at[kept] - at[k], axis=1).min() >= around.apart_m:
            kept.append(int(k))
        if len(kept) > around.kept:
            break
    return kept
