"""From similar views to the poses that registration starts from: distinct in place and heading."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from service.geometry.rigid import Rotation, Transform, inverse, transform_from
from service.localization.frames import Frame
from service.localization.prior import Prior
from service.registration.register import Start


@dataclass(frozen=True, slots=True, kw_only=True)
class StartSettings:
    """How many starts, and how far apart. Ours, November 2026.

    Attributes:
        most: so many at most.
        less_similar: views that are less similar than the best by more than this start nothing.
        apart_m: of two starts of one heading.
        apart_rad: of two starts of one place.
        temperature: similarity that a prior's logarithm is worth; near the one that training ends at.
        pooled: of several frames, so many at most are compared by what all frames say there.
    """

    most: int = 32
    less_similar: float = 0.1
    apart_m: float = 2.2
    apart_rad: float = float(np.deg2rad(20.0))
    temperature: float = 0.02
    pooled: int = 64


#: How similar all frames are, in the mean, to the map where the reference's level frame is said to stand (n, 4, 4).
Likeness = Callable[[NDArray[np.float64]], NDArray[np.float64]]


def starts_from(
    frames: tuple[Frame, ...], prior: Prior | None, *, lidar_height_m: float, settings: StartSettings,
    likeness: Likeness | None = None,
) -> list[Start]:  # fmt: skip
    """Level poses of the reference camera at the most similar views that are distinct.

    Args:
        frames: the reference first; what another frame resembles is carried over to where the reference then stood.
        prior: moves what fits it forward; half of the starts are taken without it, since it may be wrong.
        lidar_height_m: of the places above their ground.
        settings: how many.
        likeness: ranks the starts of several frames; what a single one resembles can else crowd out what all of them do.
    """
    poses = np.concatenate([_poses(frame, frames[0], lidar_height_m) for frame in frames])
    similarity = np.concatenate([frame.matches.similarity for frame in frames])
    kept = _chosen(poses, similarity, prior, settings, settings.most if likeness is None else settings.pooled)
    if likeness is not None:
        poses, similarity = poses[kept], likeness(poses[kept])
        kept = _chosen(poses, similarity, prior, settings, settings.most)
    # Without the prior: it is weighed at the end, when rivals have been registered too.
    return [Start(poses[k, :3, :3], poses[k, :3, 3], number, float(similarity[k])) for number, k in enumerate(kept)]


def _chosen(
    poses: NDArray[np.float64], similarity: NDArray[np.float64], prior: Prior | None, settings: StartSettings, most: int
) -> list[int]:
    """Rows of the most similar poses that are distinct; with a prior, half of them by it and half without it."""
    heading = np.arctan2(poses[:, 1, 0], poses[:, 0, 0])
    allowed = similarity >= similarity.max() - settings.less_similar
    rank = similarity
    if prior is not None:
        rank = similarity + settings.temperature * prior.log_weight(poses[:, :2, 3], heading)
        allowed |= rank >= rank.max() - settings.less_similar
    order = np.argsort(-rank, kind="stable")
    first = most if prior is None else (most + 1) // 2
    kept = _distinct(order[allowed[order]], poses[:, :2, 3], heading, [], first, settings)
    if prior is not None:
        order = np.argsort(-similarity, kind="stable")
        kept = _distinct(order[allowed[order]], poses[:, :2, 3], heading, kept, most, settings)
    return kept


def _poses(frame: Frame, reference: Frame, lidar_height_m: float) -> Float64[NDArray[np.float64], "n 4 4"]:
    """T_map_level of the reference camera for every match of a frame."""
    matches = frame.matches
    up = matches.T_map_place[:, :3, 2]
    x = np.stack([np.cos(matches.heading_rad), np.sin(matches.heading_rad), np.zeros(len(matches))], axis=1)
    x -= up * (x * up).sum(axis=1, keepdims=True)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    T = np.tile(np.eye(4), (len(matches), 1, 1))
    T[:, :3, :3] = np.stack([x, np.cross(up, x), up], axis=2)
    T[:, :3, 3] = matches.T_map_place[:, :3, 3] + (frame.views.height_m - lidar_height_m) * up
    if frame is reference:
        return T
    T_level_level = level_from(frame.T_reference_camera, frame.R_level_camera, reference.R_level_camera)
    carried: Float64[NDArray[np.float64], "n 4 4"] = T @ inverse(T_level_level)
    return carried


def level_from(T_reference_camera: Transform, R_level_camera: Rotation, R_level_reference: Rotation) -> Transform:
    """T_level_level: from a frame's level frame, at its camera, to the reference's at its own."""
    R = R_level_reference @ T_reference_camera[:3, :3] @ R_level_camera.T
    return transform_from(R, R_level_reference @ T_reference_camera[:3, 3])


def _distinct(
    rows: NDArray[np.intp], xy: NDArray[np.float64], heading: NDArray[np.float64], kept: list[int], most: int, settings: StartSettings
) -> list[int]:  # fmt: skip
    """``kept`` and as many of the rows, in their order, as stand apart from all before them."""
    kept = list(kept)
    for row in rows:
        if len(kept) == most:
            break
        near = np.hypot(*(xy[kept] - xy[row]).T) < settings.apart_m
        alike = np.cos(heading[kept] - heading[row]) > np.cos(settings.apart_rad)
        if not (near & alike).any():
            kept.append(int(row))
    return kept
