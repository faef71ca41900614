"""From similar views to the starts of registration: poses that are distinct in position and heading."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from service.geometry.rigid import Transform, inverse
from service.registration.register import Start
from service.retrieval.prior import Prior
from service.retrieval.retrieve import EncodedFrame


@dataclass(frozen=True, slots=True, kw_only=True)
class StartSettings:
    """Number of starts and their distance from each other. Our own choice, November 2026.

    Attributes:
        most: largest number of starts.
        less_similar: largest loss of similarity against the best view. A view with a larger loss gives no start.
        apart_m: smallest distance of two starts with the same heading.
        apart_rad: smallest difference in heading of two starts at the same place.
        temperature: similarity per nat of a prior's log weight; near the softmax temperature at the end of training.
        pooled: largest number of starts, in a query of several frames, that are ranked by the mean similarity of all frames.
    """

    most: int = 32
    less_similar: float = 0.1
    apart_m: float = 2.2
    apart_rad: float = float(np.deg2rad(20.0))
    temperature: float = 0.02
    pooled: int = 64


#: Function from poses T_map_level of the reference (n, 4, 4) to the mean similarity of all frames to the map there (n,).
SimilarityFunction = Callable[[NDArray[np.float64]], NDArray[np.float64]]


def starts_from(
    frames: tuple[EncodedFrame, ...],
    prior: Prior | None,
    *,
    lidar_height_m: float,
    settings: StartSettings,
    similarity_at: SimilarityFunction | None = None,
) -> list[Start]:
    """Select the most similar distinct poses of the reference's level frame.

    Args:
        frames: image pairs, the reference first. A match of another frame gives the pose of the reference at that time.
        prior: prior of the reference pose; None if nothing is known. Half of the starts ignore the prior, because it may be wrong.
        lidar_height_m: height of the places' LiDAR above the ground, m.
        settings: number of starts and their distance.
        similarity_at: ranks the starts of several frames by their mean similarity; None for one frame. Without it, perceptual aliases of
            single frames could crowd out the right place (decision 0071).
    """
    poses = poses_of_matches(frames, lidar_height_m)
    similarity = np.concatenate([frame.matches.similarity for frame in frames])
    kept = _chosen(poses, similarity, prior, settings, settings.most if similarity_at is None else settings.pooled)
    if similarity_at is not None:
        poses, similarity = poses[kept], similarity_at(poses[kept])
        kept = _chosen(poses, similarity, prior, settings, settings.most)
    # The similarity of a start excludes the prior. The support includes it later, when the rivals are registered too.
    return [Start(poses[k, :3, :3], poses[k, :3, 3], number, float(similarity[k])) for number, k in enumerate(kept)]


def _chosen(
    poses: NDArray[np.float64], similarity: NDArray[np.float64], prior: Prior | None, settings: StartSettings, most: int
) -> list[int]:
    """Return the rows of the most similar distinct poses. A prior ranks the first half of them and does not count in the rest."""
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


def start_positions_m(
    frames: tuple[EncodedFrame, ...], predicted: tuple[Transform, ...], lidar_height_m: float
) -> Float64[NDArray[np.float64], "n 3"]:
    """Return the positions of the reference that a registration may start from, map frame, m, the most important first.

    Args:
        frames: image pairs, the reference first.
        predicted: poses T_map_camera of the reference from odometry. They come first.
        lidar_height_m: height of the places' LiDAR above the ground, m.
    """
    poses = poses_of_matches(frames, lidar_height_m)
    similarity = np.concatenate([frame.matches.similarity for frame in frames])
    similar = poses[np.argsort(-similarity, kind="stable"), :3, 3]
    return np.concatenate([np.array([T[:3, 3] for T in predicted]).reshape(-1, 3), similar])


def poses_of_matches(frames: tuple[EncodedFrame, ...], lidar_height_m: float) -> Float64[NDArray[np.float64], "n 4 4"]:
    """Return T_map_level of the reference for every match of every frame.

    Args:
        frames: image pairs, the reference first. A match of another frame gives the pose of the reference at that time.
        lidar_height_m: height of the places' LiDAR above the ground, m.
    """
    return np.concatenate([_poses(frame, frames[0], lidar_height_m) for frame in frames])


def _poses(
    frame: EncodedFrame, reference: EncodedFrame, lidar_height_m: float
) -> Float64[NDArray[np.float64], "n 4 4"]:
    """Compute T_map_level of the reference for every match of a frame."""
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
    carried: Float64[NDArray[np.float64], "n 4 4"] = T @ inverse(frame.T_reference_level(reference))
    return carried


def _distinct(
    rows: NDArray[np.intp],
    xy: NDArray[np.float64],
    heading: NDArray[np.float64],
    kept: list[int],
    most: int,
    settings: StartSettings,
) -> list[int]:
    """Add rows in their order to ``kept``, up to ``most``, if they are distinct from all rows before them."""
    kept = list(kept)
    for row in rows:
        if len(kept) == most:
            break
        near = np.hypot(*(xy[kept] - xy[row]).T) < settings.apart_m
        same_heading = np.cos(heading[kept] - heading[row]) > np.cos(settings.apart_rad)
        if not (near & same_heading).any():
            kept.append(int(row))
    return kept
