"""Odometry and loops brought into one consistent drive: a pose graph, solved by GTSAM (Dellaert and Kaess, 2017)."""

from itertools import pairwise

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from model_training.odometry.keyframes import Drive
from model_training.odometry.loops import Loop
from service.geometry.rigid import inverse

#: Standard deviations, rotation (rad) first as GTSAM has it: of odometry for each square root of a metre, and of a loop.
ODOMETRY_SIGMAS = np.array([0.0007, 0.0007, 0.0007, 0.01, 0.01, 0.01])
LOOP_SIGMAS = np.array([0.003, 0.003, 0.003, 0.05, 0.05, 0.05])
#: Of a given pose. Its errors last for dozens of metres, which the graph takes for independent: so each counts for less than its own.
GIVEN_SIGMAS = np.array([0.02, 0.02, 0.03, 3.0, 3.0, 3.0])
#: Beyond so many standard deviations a loop, or a given pose, counts for less and less: it may be another place that looks the same.
ROBUST = 3.0

Transforms = Float64[NDArray[np.float64], "N 4 4"]


def closed(drive: Drive, loops: list[Loop]) -> Transforms:
    """T_first_lidar of every scan with the loops closed.

    Between keyframes the correction is carried on rigidly from the keyframe before, so that what odometry says of
    neighbouring scans stays as it is.
    """
    corrected = _solved(drive, loops)
    keyframes = drive.keyframes
    stamps = np.array([keyframe.stamp_s for keyframe in keyframes])
    owner = np.clip(np.searchsorted(stamps, drive.stamps_s, side="right") - 1, 0, len(keyframes) - 1)
    corrections = np.stack([T @ inverse(k.T_first_lidar) for T, k in zip(corrected, keyframes, strict=True)])
    result: Transforms = corrections[owner] @ drive.T_first_lidar
    return result


def disagreement_m(T_first_keyframe: Transforms, loops: list[Loop]) -> float:
    """How far, in the mean, poses are from what the loops say: what is left of the drift where places were met again."""
    away = [
        (inverse(T_first_keyframe[loop.earlier]) @ T_first_keyframe[loop.later])[:3, 3] - loop.T_earlier_later[:3, 3]
        for loop in loops
    ]
    return float(np.mean(np.linalg.norm(away, axis=1))) if away else 0.0


def held_near(T_map_steps: Transforms, T_map_given: Transforms) -> Transforms:
    """Poses whose steps are those of a chain, and whose whole stays where given poses have it.

    Args:
        T_map_steps: of a drive, by odometry: right from one to the next, drifting as a whole.
        T_map_given: of the same moments, by GNSS or an inertial system: off by decimetres each, not drifting.
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


def _solved(drive: Drive, loops: list[Loop]) -> Transforms:
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
