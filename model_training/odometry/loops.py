"""Find loops of a traversal: descriptors in all directions propose them, registration verifies them."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from model_training.mapping.voxel_map import VoxelMap
from model_training.odometry.keyframes import HEADINGS, Keyframe, OdometryTrajectory
from service.geometry.rigid import Transform, inverse, rotation_z, transform_from, transform_points
from service.registration.kernel import QueryPoints
from service.registration.register import RegistrationSettings, Start, register
from service.registration.surfel_map import SurfelMap


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopSettings:
    """Thresholds of the loop search, chosen in November 2026 on validation cities.

    Attributes:
        apart_m: least distance travelled between two keyframes of a loop, metres.
        every: one of this many keyframes is looked up.
        drift: allowed distance between two visits of one place, as a share of the distance travelled between them.
        slack_m: allowed distance that is added to it, metres.
        similarity: least mean similarity over all views, at the best rotation, for which registration is tried.
        around: keyframes before and after the earlier visit that form its cloud.
        voxel_m: voxel size of that cloud, metres.
        points: registered points of the later visit.
        sigma_m: range noise of a thinned scan, metres.
        inliers: least share of inliers that verifies a loop.
    """

    apart_m: float = 40.0
    every: int = 2
    drift: float = 0.03
    slack_m: float = 8.0
    similarity: float = 0.6
    around: int = 6
    voxel_m: float = 0.3
    points: int = 2500
    sigma_m: float = 0.05
    inliers: float = 0.75


@dataclass(frozen=True, slots=True)
class Loop:
    """A verified loop.

    Attributes:
        earlier: index of the earlier keyframe.
        later: index of the later keyframe.
        T_earlier_later: pose of the later LiDAR in the frame of the earlier one.
        inliers: share of inliers of the registration.
        similarity: mean similarity of the descriptors at the best rotation.
    """

    earlier: int
    later: int
    T_earlier_later: Transform
    inliers: float
    similarity: float


def find_loops(
    drive: OdometryTrajectory,
    settings: LoopSettings = LoopSettings(),
    *,
    report: Callable[[int, int], None] = lambda *_: None,
) -> list[Loop]:
    """Find loops of a traversal, at most one per keyframe that is looked up.

    Args:
        drive: with keyframes.
        settings: thresholds.
        report: called with the keyframes done and all keyframes that are looked up.
    """
    keyframes = drive.keyframes
    if not keyframes:
        return []
    views = np.stack([keyframe.descriptors for keyframe in keyframes])
    travelled = np.array([keyframe.travelled_m for keyframe in keyframes])
    xyz = np.array([keyframe.T_first_lidar[:3, 3] for keyframe in keyframes])
    looked_up = range(0, len(keyframes), settings.every)
    loops = []
    for done, k in enumerate(looked_up, 1):
        between = travelled[k] - travelled
        near = np.linalg.norm(xyz - xyz[k], axis=1) < settings.slack_m + settings.drift * between
        rows = np.flatnonzero((between > settings.apart_m) & near)
        if len(rows):
            similarity, turn = all_round(views[k], views[rows])
            best = int(np.argmax(similarity))
            if similarity[best] >= settings.similarity:
                loop = _proved(
                    drive, keyframes[k], keyframes[rows[best]], int(turn[best]), float(similarity[best]), settings
                )
                if loop is not None:
                    loops.append(loop)
        report(done, len(looked_up))
    return loops


def all_round(
    one: NDArray[np.float32], others: NDArray[np.float32]
) -> tuple[Float64[NDArray[np.float64], " N"], NDArray[np.intp]]:
    """Compute the mean similarity of a place's views to those of other places, at the best rotation of each.

    Args:
        one: descriptors of the place, counter-clockwise (H, D).
        others: descriptors of N other places, counter-clockwise (N, H, D).

    Returns:
        Similarities (N,) and rotations (N,): the number of the other's view that matches the first view of ``one``.
    """
    count = len(one)
    products = np.einsum("hd,ngd->nhg", one, others, optimize=True)
    h = np.arange(count)
    by_turn = np.stack([products[:, h, (h + turn) % count].mean(axis=1) for turn in range(count)], axis=1)
    turn = by_turn.argmax(axis=1)
    return by_turn.max(axis=1).astype(np.float64), turn


def _proved(
    drive: OdometryTrajectory, later: Keyframe, earlier: Keyframe, turn: int, similarity: float, settings: LoopSettings
) -> Loop | None:
    """Register the later visit against the cloud of the earlier one; None if too few points are inliers."""
    cloud = _cloud(drive, earlier, settings)
    T_first_level = earlier.T_first_lidar @ transform_from(earlier.level.R_level_sensor.T, np.zeros(3))
    turned = earlier.start_rad + 2 * np.pi * turn / HEADINGS - later.start_rad
    start = Start(T_first_level[:3, :3] @ rotation_z(turned), T_first_level[:3, 3], 0, similarity)
    points = _query_points(drive, later, settings)
    found = register(cloud, points, [start], later.level.height_m, RegistrationSettings())[0]
    if found.inliers < settings.inliers:
        return None
    T_first_later = transform_from(found.R_map_level @ later.level.R_level_sensor, found.camera_m)
    return Loop(earlier.index, later.index, inverse(earlier.T_first_lidar) @ T_first_later, found.inliers, similarity)


def _cloud(drive: OdometryTrajectory, middle: Keyframe, settings: LoopSettings) -> SurfelMap:
    """Surfels of the keyframes around one, in the odometry frame."""
    voxels = VoxelMap(settings.voxel_m, np.round(middle.T_first_lidar[:3, 3]))
    low, high = max(0, middle.index - settings.around), middle.index + settings.around + 1
    for keyframe in drive.keyframes[low:high]:
        voxels.add(transform_points(keyframe.T_first_lidar, drive.points(keyframe.index).astype(np.float64)))
    return SurfelMap.prepare(voxels.origin, *voxels.surfels())


def _query_points(drive: OdometryTrajectory, keyframe: Keyframe, settings: LoopSettings) -> QueryPoints:
    xyz = drive.points(keyframe.index) @ keyframe.level.R_level_sensor.T.astype(np.float32)
    rows = np.linspace(0, len(xyz) - 1, min(settings.points, len(xyz))).astype(np.intp)
    chosen = np.ascontiguousarray(xyz[rows], np.float32)
    length = np.linalg.norm(chosen, axis=1, keepdims=True)
    one = np.ones(len(chosen), np.float32)
    return QueryPoints(chosen, (chosen / length).astype(np.float32), settings.sigma_m * one, one, 0 * one)
