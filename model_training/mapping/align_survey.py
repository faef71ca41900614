"""Align the scans of a survey: register every scan against the map of all scans, in several rounds.

The poses of a survey have errors of centimetres. The errors differ at every visit and every few dozen metres. So a map from the given
poses has walls that are too thick. A scan itself is more accurate than its pose. Each round builds a coarse map of all scans at their
current poses and registers each scan against it. The errors average out over surfaces that several scans see.

A common offset of all scans is unobservable. A prior holds each scan near its given pose, so the traversal as a whole stays in place.
"""

from collections.abc import Callable
from functools import partial

import numpy as np
from jaxtyping import Float32, Float64, Int16
from numpy.typing import NDArray

from model_training.datasets.dataset import Dataset
from model_training.mapping.voxel_map import VoxelMap, lattice_origin
from service.geometry.lengths import lengths
from service.geometry.rigid import transform_points
from service.registration.kernel import STATE, QueryPoints, SolverOptions, align
from service.registration.surfel_map import SurfelMap

#: Number of rounds.
ROUNDS = 4
#: Largest number of points of a scan, and their smallest and largest range. Nearer points lie on the vehicle. Farther points constrain
#: the angles of the scan more than its position.
POINTS, NEAREST_M, REACH_M = 3000, 2.5, 40.0
#: Unit of the stored coordinates, metres. 16 bits take half the memory, and their rounding is a thirtieth of ``SIGMA_M``.
_UNIT_M = REACH_M / 32767
#: Edge of a voxel of the coarse map, metres.
VOXEL_M = 0.4
#: Noise of a LiDAR range, and roughness of surfaces; standard deviations in metres.
SIGMA_M, SURFACE_M = 0.02, 0.02
#: Prior around the given pose: standard deviations of position and tilt, and its information in units of points.
POSITION_M, TILT_RAD, HELD_BY = 0.03, float(np.deg2rad(0.05)), 10.0
#: Largest distance between a point and its surfel, metres. The given poses are surveyed, so a larger distance is a wrong match.
OFF_M = 0.5
#: A scan with fewer points than this on surfaces that another scan has measured keeps its pose.
FEWEST = 300
_SOLVER = SolverOptions(
    iterations=6,
    reach=OFF_M,
    robust_first=0.1,
    robust_last=0.05,
    surface=SURFACE_M,
    prior_weight=HELD_BY / POINTS,
    tilt=TILT_RAD,
    height=POSITION_M,
    position=POSITION_M,
    free_scale=False,
)

#: Number of scans whose points go into the voxel map at once.
_TOGETHER = 64

Poses = Float64[NDArray[np.float64], "N 4 4"]
Points = Float32[NDArray[np.float32], "n 3"]
#: Points in units of ``_UNIT_M``.
Stored = Int16[NDArray[np.int16], "n 3"]
#: Progress callback: stage, finished steps, all steps.
Report = Callable[[str, int, int], None]


def aligned(dataset: Dataset, poses: Poses, kept: NDArray[np.int64], *, report: Report = lambda *_: None) -> Poses:
    """Compute T_map_lidar of every scan (N, 4, 4) after alignment.

    A scan that does not take part moves like the last scan before it that does.

    Args:
        dataset: the dataset with the survey's scans.
        poses: T_map_lidar of every scan as the survey gives it.
        kept: indices of the scans that take part, ascending (K,).
        report: called after every scan that was read and after every scan that was registered.
    """
    steps = len(kept) * (1 + ROUNDS)
    scans = []
    for done, number in enumerate(kept):
        thinned = _thinned(dataset.scan(int(number))[:, :3], dataset.number_in_survey(int(number)))
        scans.append(np.rint(thinned / _UNIT_M).astype(np.int16))
        report("survey", done + 1, steps)
    now = poses[kept].copy()
    for done in range(ROUNDS):
        # A function, so that the map of a round is gone before the next one is built.
        _align_once(scans, now, poses[kept], partial(_report_step, report, len(kept) * (1 + done), steps))
    owner = np.clip(np.searchsorted(kept, np.arange(len(poses)), side="right") - 1, 0, len(kept) - 1)
    moved: Poses = (now @ np.linalg.inv(poses[kept]))[owner] @ poses
    return moved


def _report_step(report: Report, before: int, steps: int, done: int) -> None:
    report("survey", before + done, steps)


def _align_once(scans: list[Stored], now: Poses, given: Poses, report: Callable[[int], None]) -> None:
    """Build the map of all scans and register each against it. The poses ``now`` change in place."""
    voxels, shared = _map_of(scans, now)
    surfels, brightness = voxels.surfels()
    if not len(surfels):
        return
    cloud = SurfelMap.prepare(voxels.origin, surfels, brightness)
    for k, stored in enumerate(scans):
        common = _in_metres(stored).compress(shared[k], axis=0)
        if len(common) >= FEWEST:
            now[k] = _registered(cloud, common, now[k], given[k])
        report(k + 1)


def _thinned(points: Points, number: int) -> Points:
    """Return at most ``POINTS`` points of a scan, drawn at random.

    Near points are the most frequent. So the probability of a point is proportional to its range. The scan's number is the seed: every
    run draws the same points (Efraimidis and Spirakis, Information Processing Letters 97, 2006).
    """
    range_m = lengths(points)
    points, range_m = (each.compress((range_m > NEAREST_M) & (range_m < REACH_M), axis=0) for each in (points, range_m))
    if len(points) > POINTS:
        waiting = np.random.default_rng(number).standard_exponential(len(points), np.float32) / range_m
        points = points.take(np.sort(np.argpartition(waiting, POINTS)[:POINTS]), axis=0)
    return np.ascontiguousarray(points, np.float32)


def _in_metres(stored: Stored) -> Points:
    return stored * np.float32(_UNIT_M)


def _placed(points: Points, T: NDArray[np.float64]) -> NDArray[np.float64]:
    return transform_points(T, points.astype(np.float64))


def _map_of(scans: list[Stored], poses: Poses) -> tuple[VoxelMap, list[NDArray[np.bool_]]]:
    """Build the voxel map of all scans; return it with, for each scan, whether each point shares its voxel with another scan.

    Only these points take part in registration. On a surface that no other scan has seen, a scan matches itself. There the rounding of
    the map would make its pose drift.
    """
    voxels = VoxelMap(VOXEL_M, lattice_origin(VOXEL_M, poses[:, :3, 3].mean(axis=0)))
    groups = []
    for first in range(0, len(scans), _TOGETHER):
        some = zip(scans[first:][:_TOGETHER], poses[first:], strict=False)
        placed = [_placed(_in_metres(stored), T) for stored, T in some]
        source = np.repeat(np.arange(len(placed)), [len(each) for each in placed])
        groups.append(voxels.add_from(np.concatenate(placed), source))
    found, times = np.unique(np.concatenate([keys for keys, _, _ in groups]), return_counts=True)
    of_several = times > 1
    for keys, in_group, _ in groups:
        of_several[np.searchsorted(found, keys[in_group])] = True
    shared = list[NDArray[np.bool_]]()
    for number, (keys, _, row_of) in enumerate(groups):
        points = of_several[np.searchsorted(found, keys)][row_of]
        counts = [len(each) for each in scans[number * _TOGETHER :][:_TOGETHER]]
        shared += np.split(points, np.cumsum(counts)[:-1])
    return voxels, shared


def _registered(
    cloud: SurfelMap, points: Points, T: NDArray[np.float64], T_given: NDArray[np.float64]
) -> NDArray[np.float64]:
    state = np.zeros(1, STATE)
    state["R"], state["t"] = T[:3, :3], T[:3, 3] - cloud.origin_m
    state["anchor"], state["up"] = T_given[:3, 3] - cloud.origin_m, T_given[:3, 2]
    one = np.ones(len(points), np.float32)
    ray = (points.T / lengths(points)).T  # NumPy is slow for rows of three
    measured = QueryPoints(points, ray, np.float32(SIGMA_M) * one, one, 0 * one)
    align(cloud.pieces, measured, state, _SOLVER, tolerance_m=0.0)  # nobody reads the score
    found = np.eye(4)
    found[:3, :3], found[:3, 3] = state["R"][0], state["t"][0] + cloud.origin_m
    return found
