"""Fuse odometry and loops in a pose graph, solved by GTSAM (Dellaert and Kaess, 2017)."""

from itertools import pairwise

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from model_training.odometry.keyframes import OdometryTrajectory
from model_training.odometry.loops import Loop
from service.geometry.rigid import inverse

#: Standard deviations of odometry per square root of a metre: rotation (rad) first, as in GTSAM, then translation (m).
ODOMETRY_SIGMAS = np.array([0.0007, 0.0007, 0.0007, 0.01, 0.01, 0.01])
#: Standard deviations of a loop, in the same order.
LOOP_SIGMAS = np.array([0.003, 0.003, 0.003, 0.05, 0.05, 0.05])
#: Standard deviations of a given pose. They are larger than its error: the error is correlated over dozens of metres,
#: and the graph assumes independent errors.
GIVEN_SIGMAS = np.array([0.02, 0.02, 0.03, 3.0, 3.0, 3.0])
#: Threshold of the robust kernel, standard deviations. A loop beyond it may be a perceptual alias.
ROBUST = 3.0

Transforms = Float64[NDArray[np.float64], "N 4 4"]


def closed(drive: OdometryTrajectory, loops: list[Loop]) -> Transforms:
    """Return T_first_lidar of every scan after loop closure (N, 4, 4).

    Between keyframes the correction of the keyframe before is applied rigidly. So the relative poses of neighbouring scans
    stay as odometry gives them.

    Args:
        drive: traversal with at least one keyframe.
        loops: verified loops.
    """
    corrected = _solved(drive, loops)
    keyframes = drive.keyframes
    stamps = np.array([keyframe.stamp_s for keyframe in keyframes])
    owner = np.clip(np.searchsorted(stamps, drive.stamps_s, side="right") - 1, 0, len(keyframes) - 1)
    corrections = np.stack([T @ inverse(k.T_first_lidar) for T, k in zip(corrected, keyframes, strict=True)])
    result: Transforms = corrections[owner] @ drive.T_first_lidar
    return result


def disagreement_m(T_first_keyframe: Transforms, loops: list[Loop]) -> float:
    """Return the mean distance of poses from the loops, metres: the remaining drift at revisited places.

    Args:
        T_first_keyframe: poses of the keyframes (N, 4, 4).
        loops: verified loops.
    """
    away = [
        (inverse(T_first_keyframe[loop.earlier]) @ T_first_keyframe[loop.later])[:3, 3] - loop.T_earlier_later[:3, 3]
        for loop in loops
    ]
    return float(np.mean(np.linalg.norm(away, axis=1))) if away else 0.0


def held_near(T_map_steps: Transforms, T_map_given: Transforms) -> Transforms:
    """Fuse a chain of accurate steps with given poses that do not drift.

    Args:
        T_map_steps: poses from odometry (N, 4, 4): each step is accurate, the whole drifts.
        T_map_given: poses of GNSS or an inertial system at the same times (N, 4, 4): each errs by decimetres, without drift.

    Returns:
        T_map (N, 4, 4).
    """
    import gtsam

    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    given_noise = gtsam.noiseModel.Robust.Create(
        gtsam.noiseModel.mEstimator.Huber.Create(ROBUST), gtsam.noiseModel.Diagonal.Sigmas(GIVEN_SIGMAS)
    )
    for k, T in enumerate(T_map_given):
        start.insert(k, gtsam.Pose3(T))
        graph.add(gtsam.PriorFactorPose3(k, gtsam.Pose3(T), given_noise))
    for k, (before, after) in enumerate(pairwise(T_map_steps)):
        step = inverse(before) @ after
        noise = gtsam.noiseModel.Diagonal.Sigmas(
            ODOMETRY_SIGMAS * np.sqrt(max(0.1, float(np.linalg.norm(step[:3, 3]))))
        )
        graph.add(gtsam.BetweenFactorPose3(k, k + 1, gtsam.Pose3(step), noise))
    solved = gtsam.LevenbergMarquardtOptimizer(graph, start).optimize()
    return np.stack([solved.atPose3(k).matrix() for k in range(len(T_map_given))])


def _solved(drive: OdometryTrajectory, loops: list[Loop]) -> Transforms:
    import gtsam

    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    keyframes = drive.keyframes
    graph.add(
        gtsam.PriorFactorPose3(
            0, gtsam.Pose3(keyframes[0].T_first_lidar), gtsam.noiseModel.Diagonal.Sigmas(np.full(6, 1e-6))
        )
    )
    for keyframe in keyframes:
        start.insert(keyframe.index, gtsam.Pose3(keyframe.T_first_lidar))
    for before, after in pairwise(keyframes):
        step_m = max(0.1, after.travelled_m - before.travelled_m)
        noise = gtsam.noiseModel.Diagonal.Sigmas(ODOMETRY_SIGMAS * np.sqrt(step_m))
        between = gtsam.Pose3(inverse(before.T_first_lidar) @ after.T_first_lidar)
        graph.add(gtsam.BetweenFactorPose3(before.index, after.index, between, noise))
    robust = gtsam.noiseModel.Robust.Create(
        gtsam.noiseModel.mEstimator.Cauchy.Create(ROBUST), gtsam.noiseModel.Diagonal.Sigmas(LOOP_SIGMAS)
    )
    for loop in loops:
        graph.add(gtsam.BetweenFactorPose3(loop.earlier, loop.later, gtsam.Pose3(loop.T_earlier_later), robust))
    solved = gtsam.LevenbergMarquardtOptimizer(graph, start).optimize()
    return np.stack([solved.atPose3(keyframe.index).matrix() for keyframe in keyframes])
