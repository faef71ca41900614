"""Survey poses brought into agreement: every scan is registered on the map that all of them make, over and over.

Poses of a survey are off by centimetres, differently at every visit and every few dozen metres, so the map of them is thicker than its
walls. Scans themselves are measured better than that. Each round builds a coarse map of all scans where they are said to stand and
moves each onto it; errors average out over what scans see in common. The drive as a whole stays where it was: what all scans have
in common no scan can tell, and each is held near its given pose.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float32, Float64
from numpy.typing import NDArray

from model_training.datasets.dataset import Dataset
from model_training.mapping.voxel_map import VoxelMap, lattice_origin
from service.geometry.rigid import transform_points
from service.registration.kernel import STATE, QueryPoints, SolverOptions, align
from service.registration.surfel_map import SurfelMap

ROUNDS = 4
#: Points of a scan that take part, and their ranges: nearer ones are the vehicle, further ones tell more of its angles than of its place.
POINTS, NEAREST_M, REACH_M = 3000, 2.5, 40.0
VOXEL_M = 0.4
#: Noise of a LiDAR's range, and roughness of surfaces, metres.
SIGMA_M, SURFACE_M = 0.02, 0.02
#: Of the given poses, metres and radians: what they are held with, as if so many points said so.
POSITION_M, TILT_RAD, HELD_BY = 0.03, float(np.deg2rad(0.05)), 10.0
#: Points further off the map than this say nothing: the given poses are surveyed ones.
OFF_M = 0.5
#: Scans of which fewer points lie where another scan has measured too stay where they are.
FEWEST = 300
_SOLVER = SolverOptions(
    iterations=6, reach=OFF_M, robust_first=0.1, robust_last=0.05, surface=SURFACE_M, prior_weight=HELD_BY / POINTS, tilt=TILT_RAD,
    height=POSITION_M, position=POSITION_M, free_scale=False,
)  # fmt: skip

_TOGETHER = 64  # scans whose points are summed up at once

Poses = Float64[NDArray[np.float64], "N 4 4"]
Points = Float32[NDArray[np.float32], "n 3"]
Report = Callable[[str, int, int], None]


def aligned(dataset: Dataset, poses: Poses, kept: NDArray[np.int64], *, report: Report = lambda *_: None) -> Poses:
    """T_map_lidar of every scan, brought into agreement; those between two kept ones move as the one before.

    Args:
        dataset: with the scans.
        poses: as the survey gives them.
        kept: numbers of the scans that take part.
        report: told after every scan that was read, and every one that was registered.
    """
    steps = len(kept) * (1 + ROUNDS)
    scans = []
    for done, number in enumerate(kept):
        scans.append(_thinned(dataset.scan(int(number))[:, :3], int(number)))
        report("survey", done + 1, steps)
    now = poses[kept].copy()
    for done in range(ROUNDS):
        voxels, shared = _map_of(scans, now)
        surfels = voxels.surfels()
        if not len(surfels.positions):
            break
        cloud = SurfelMap.prepare(voxels.origin, *voxels.tiles(surfels))
        for k, points in enumerate(scans):
            common = points[_are_of(voxels.keys_of(_placed(points, now[k])), shared)]
            if len(common) >= FEWEST:
                now[k] = _registered(cloud, common, now[k], poses[kept[k]])
            report("survey", len(kept) * (1 + done) + k + 1, steps)
    owner = np.clip(np.searchsorted(kept, np.arange(len(poses)), side="right") - 1, 0, len(kept) - 1)
    moved: Poses = (now @ np.linalg.inv(poses[kept]))[owner] @ poses
    return moved


def _thinned(points: Points, number: int) -> Points:
    """Some of a scan, drawn with its range, since near ones are the most; the same whenever it is read."""
    range_m = np.linalg.norm(points, axis=1)
    points, range_m = (each[(range_m > NEAREST_M) & (range_m < REACH_M)] for each in (points, range_m))
    if len(points) > POINTS:
        chance = range_m.astype(np.float64) / range_m.sum(dtype=np.float64)
        chosen = np.random.default_rng(number).choice(len(points), POINTS, replace=False, p=chance / chance.sum())
        points = points[chosen]
    return np.ascontiguousarray(points, np.float32)


def _placed(points: Points, T: NDArray[np.float64]) -> NDArray[np.float64]:
    return transform_points(T, points.astype(np.float64))


def _map_of(scans: list[Points], poses: Poses) -> tuple[VoxelMap, NDArray[np.int64]]:
    """The map that scans make, and the keys of its voxels that more than one of them has points in, sorted.

    On surfaces that it alone has seen a scan lies as it is, and rounding of its own would make it wander.
    """
    voxels = VoxelMap(VOXEL_M, lattice_origin(VOXEL_M, poses[:, :3, 3].mean(axis=0)))
    each_once: list[NDArray[np.int64]] = []
    for first in range(0, len(scans), _TOGETHER):
        placed = [_placed(points, T) for points, T in zip(scans[first:][:_TOGETHER], poses[first:], strict=False)]
        voxels.add(np.concatenate(placed))
        each_once += [np.unique(voxels.keys_of(each)) for each in placed]
    keys, times = np.unique(np.concatenate(each_once), return_counts=True)
    return voxels, keys[times > 1]


def _are_of(keys: NDArray[np.int64], some: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which keys are among some that are sorted."""
    at = np.minimum(np.searchsorted(some, keys), max(len(some) - 1, 0))
    found: NDArray[np.bool_] = some[at] == keys if len(some) else np.zeros(len(keys), bool)
    return found


def _registered(
    cloud: SurfelMap, points: Points, T: NDArray[np.float64], T_given: NDArray[np.float64]
) -> NDArray[np.float64]:
    state = np.zeros(1, STATE)
    state["R"], state["t"] = T[:3, :3], T[:3, 3] - cloud.origin_m
    state["anchor"], state["up"] = T_given[:3, 3] - cloud.origin_m, T_given[:3, 2]
    one = np.ones(len(points), np.float32)
    ray = points / np.linalg.norm(points, axis=1, keepdims=True)
    measured = QueryPoints(points, ray, np.float32(SIGMA_M) * one, one, 0 * one)
    align(cloud.grid, cloud.surfels, measured, state, _SOLVER)
    found = np.eye(4)
    found[:3, :3], found[:3, 3] = state["R"][0], state["t"][0] + cloud.origin_m
    return found
