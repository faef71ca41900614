"""Places between the scans of a sparse survey: poses on the way, with the points of the scan before and the scan after.

A query between two distant scans resembles neither of them. A place on the way shows the map from nearer by. Its map views are
rendered from both scans, so they have gaps and wrong visibility where a scan did not see. At the ends of a traversal the way
continues straight on for one more distance, because a sparse survey ends up to one distance too early. Decision 0147 has the
figures.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from model_training.mapping.survey import LevelledScan
from service.geometry.rigid import Transform, inverse, transform_from, transform_points
from service.imaging.pca import principal_heading

#: Two scans farther apart than this are not scans of one way, metres. No place is put between them.
FARTHEST_M = 15.0


@dataclass(frozen=True, slots=True, eq=False)
class PlacedScan:
    """A levelled scan and its pose in the map.

    Attributes:
        scan: the levelled scan.
        T_map_level: pose of the levelled LiDAR (4, 4).
    """

    scan: LevelledScan
    T_map_level: Transform


@dataclass(frozen=True, slots=True, eq=False)
class Viewpoint:
    """A pose of which map views are rendered, and the points to render.

    Attributes:
        T_map_level: pose of the levelled LiDAR (4, 4).
        height_m: height above the ground, metres.
        points: x, y, z (metres, level frame of the pose) and intensity (n, 4).
        start_rad: heading at which the fan of views starts, radians, level frame.
    """

    T_map_level: Transform
    height_m: float
    points: NDArray[np.float32]
    start_rad: float


def at_scan(placed: PlacedScan) -> Viewpoint:
    """Return the viewpoint of a scan itself.

    Args:
        placed: the scan and its pose.
    """
    scan = placed.scan
    return Viewpoint(placed.T_map_level, scan.level.height_m, scan.points, scan.start_rad)


@dataclass(frozen=True, slots=True, eq=False)
class PlannedPlaces:
    """Which places a traversal gets.

    Attributes:
        at_scan: True for the kept scans that become places (P,).
        on_way: places between scans: their ``shares_on_way`` by the index of the later of their two kept scans.
    """

    at_scan: NDArray[np.bool_]
    on_way: Mapping[int, tuple[float, ...]]

    @classmethod
    def of(cls, poses: Float64[NDArray[np.float64], "P 4 4"], largest_m: float) -> "PlannedPlaces":
        """Plan a place at each kept scan, and places between distant scans.

        Args:
            poses: poses of the kept scans in the order of the traversal.
            largest_m: largest distance between two places, metres; 0 puts none between scans.
        """
        found = {k: shares_on_way(poses, k, largest_m) for k in range(1, len(poses))}
        return cls(np.ones(len(poses), np.bool_), {k: shares for k, shares in found.items() if shares})


def shares_on_way(poses: Float64[NDArray[np.float64], "P 4 4"], k: int, largest_m: float) -> tuple[float, ...]:
    """Return the positions of the places that scans ``k - 1`` and ``k`` give, along the line from the first to the second.

    0 is the first scan and 1 the second. Shares below 0 and above 1 lie beyond an end of a traversal.

    Args:
        poses: poses of the kept scans in the order of the traversal.
        k: index of the second scan, 1 or more.
        largest_m: largest distance between two places, metres; 0 puts none between scans.
    """
    inner = _shares(poses[k - 1], poses[k], largest_m)
    if not len(inner):
        return ()
    steps, shares = np.r_[inner, 1.0], list(inner)
    if k == 1 or not is_one_way(poses[k - 2], poses[k - 1]):
        shares += list(-steps)
    if k == len(poses) - 1 or not is_one_way(poses[k], poses[k + 1]):
        shares += list(1 + steps)
    return tuple(float(share) for share in shares)


def viewpoint_at(one: PlacedScan, other: PlacedScan, share: float) -> Viewpoint:
    """Return the viewpoint at a share of the way between two scans, with the points of both.

    Between the scans, position and height are interpolated linearly, and the rotation by slerp. Beyond an end the way goes
    straight on with the rotation of the scan there.

    Args:
        one: a scan and its pose.
        other: the next scan along the way.
        share: position on the line between them, as in ``shares_on_way``.
    """
    if 0 <= share <= 1:
        return _viewpoint(one, other, share)
    end, before, further = (one, other, -share) if share < 0 else (other, one, share - 1)
    position_m = end.T_map_level[:3, 3] + further * (end.T_map_level[:3, 3] - before.T_map_level[:3, 3])
    return _rendered((before, end), transform_from(end.T_map_level[:3, :3], position_m), end.scan.level.height_m)


def is_one_way(T_one: Transform, T_other: Transform) -> bool:
    """Return whether two successive scans belong to one traversal.

    Args:
        T_one: pose of a scan (4, 4).
        T_other: pose of the next scan (4, 4).
    """
    return float(np.linalg.norm(T_other[:3, 3] - T_one[:3, 3])) <= FARTHEST_M


def _shares(T_one: Transform, T_other: Transform, largest_m: float) -> Float64[NDArray[np.float64], " n"]:
    """Return the positions of the viewpoints on the way, 0 at the first scan and 1 at the second, without both ends."""
    if largest_m == 0 or not is_one_way(T_one, T_other):
        return np.zeros(0)
    apart_m = float(np.linalg.norm(T_other[:3, 3] - T_one[:3, 3]))
    parts = max(1, int(np.ceil(apart_m / largest_m)))
    return np.arange(1, parts) / parts


def _viewpoint(one: PlacedScan, other: PlacedScan, share: float) -> Viewpoint:
    ends = np.stack([one.T_map_level, other.T_map_level])
    R_map_level = Slerp([0.0, 1.0], Rotation.from_matrix(ends[:, :3, :3]))(share).as_matrix()
    T_map_level = transform_from(R_map_level, (1 - share) * ends[0, :3, 3] + share * ends[1, :3, 3])
    height_m = (1 - share) * one.scan.level.height_m + share * other.scan.level.height_m
    return _rendered((one, other), T_map_level, height_m)


def _rendered(scans: tuple[PlacedScan, PlacedScan], T_map_level: Transform, height_m: float) -> Viewpoint:
    """Return the viewpoint at a pose with the points of two scans."""
    points = np.concatenate([_moved(each, T_map_level) for each in scans])
    return Viewpoint(T_map_level, height_m, points, principal_heading(points[:, :3], height_m=height_m))


def _moved(placed: PlacedScan, T_map_level: Transform) -> NDArray[np.float32]:
    """Return the points of a scan in the level frame of another pose."""
    points = placed.scan.points
    T_level_scan = inverse(T_map_level) @ placed.T_map_level
    moved = points.copy()
    moved[:, :3] = transform_points(T_level_scan, points[:, :3].astype(np.float64))
    return moved
