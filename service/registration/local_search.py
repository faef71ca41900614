"""Search densely around a registered pose for other local minima.

Noisy depth creates local minima beside the right pose. A search from starts that are metres apart ends in the first one it meets.
So the neighbourhood of the best pose is searched once more. Static points then rank the poses that this search finds.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from service.geometry.rigid import rotation_z
from service.registration.kernel import STATE, QueryPoints
from service.registration.register import Registered, RegistrationSettings, registered_of, score
from service.registration.surfel_tiles import Cloud


@dataclass(frozen=True, slots=True, kw_only=True)
class LocalSearchSettings:
    """Settings of the local search, chosen on a validation city in November 2026.

    Attributes:
        from_noise: least noise at which the search pays: standard deviation of an inverse depth, 1/m, independent from pixel to
            pixel. With less noise only 2 % of the poses move. Errors that adjacent pixels share, as in stereo matching, create no
            local minima. On KITTI the search would move right poses away (decision 0129).
        offsets: of the starts from the pose: along its heading (m), across it (m), rotation about the vertical axis (rad).
        points: largest number of points in the search.
        most_poses: largest number of poses to return besides the given one.
        apart_m: least distance between any two returned poses, m. Rotation is converted to metres by ``arm_m``.
        arm_m: lever arm of a rotation, m.
    """

    from_noise: float = 1.2e-3
    offsets: tuple[tuple[float, float, float], ...] = (
        (0.0, 0.0, 0.0),
        (1.4, 0.0, 0.0),
        (-1.4, 0.0, 0.0),
        (0.0, 0.8, 0.0),
        (0.0, -0.8, 0.0),
        (0.0, 0.8, 0.09),
        (0.0, -0.8, -0.09),
        (0.0, 0.8, -0.09),
        (0.0, -0.8, 0.09),
    )
    points: int = 1500
    most_poses: int = 3
    apart_m: float = 0.25
    arm_m: float = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class LocalPose:
    """A pose that the local search found.

    Attributes:
        pose: registered, map frame.
        static_inliers: share of inliers among the static points, from 0 to 1.
    """

    pose: Registered
    static_inliers: float


def search_locally(
    cloud: Cloud,
    points: QueryPoints,
    found: Registered,
    height_m: float,
    settings: RegistrationSettings,
    around: LocalSearchSettings,
) -> list[LocalPose]:
    """Return the given pose and the best other poses around it.

    Args:
        cloud: cloud of the map.
        points: of the query, in its level frame. Static points have the largest weight.
        found: the registered pose to search around, map frame.
        height_m: height of the camera above the ground, m.
        settings: the settings that registered ``found``.
        around: settings of the local search.

    Returns:
        The given pose first, then at most ``around.most_poses`` others, those with the largest share of static inliers first.
    """
    states = np.zeros(1 + len(around.offsets), STATE)
    states["R"], states["t"] = found.R_map_level, found.camera_m - cloud.origin_m
    states["log_scale"], states["offset"] = np.log(found.scale), found.offset
    for state, (along, across, turn) in zip(states[1:], around.offsets, strict=True):
        state["R"] = found.R_map_level @ rotation_z(turn)
        state["t"] += found.R_map_level @ [along, across, 0.0]
    states["anchor"], states["up"] = states["t"], found.R_map_level[:, 2]
    cloud.align(points.thinned(around.points), states[1:], settings.fine)
    score(cloud, points, states, height_m, settings)
    static_states = states.copy()
    score(cloud, points.subset(np.flatnonzero(points.weight == points.weight.max())), static_states, height_m, settings)
    static_inliers: Float64[NDArray[np.float64], " n"] = static_states["inliers"]
    chosen = _distinct(states, static_inliers, around)
    local_poses = [
        LocalPose(registered_of(states[k], found.hypothesis, cloud.origin_m), float(static_inliers[k])) for k in chosen
    ]
    return [replace(local_poses[0], pose=found), *local_poses[1:]]


def _distinct(
    states: NDArray[Any], static_inliers: Float64[NDArray[np.float64], " n"], around: LocalSearchSettings
) -> list[int]:
    """Row of the first state, then rows of the others to keep, those with the largest share of static inliers first."""
    heading = np.unwrap(np.arctan2(states["R"][:, 1, 0], states["R"][:, 0, 0]))
    at = np.c_[states["t"], around.arm_m * heading]
    chosen = [0]
    for k in 1 + np.argsort(-static_inliers[1:], kind="stable"):
        if np.linalg.norm(at[chosen] - at[k], axis=1).min() >= around.apart_m:
            chosen.append(int(k))
        if len(chosen) > around.most_poses:
            break
    return chosen
