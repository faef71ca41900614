"""Places between the scans of a sparse survey: poses on the way, with the points of the scan before and the scan after.

A query between two distant scans resembles neither of them. A place on the way shows the map from nearer by. Its map views are
rendered from both scans, so they have gaps and wrong visibility where a scan did not see. Decision 0147 has the figures.
"""

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


def between(one: PlacedScan, other: PlacedScan, largest_m: float) -> list[Viewpoint]:
    """Return evenly spread viewpoints between two scans, so that no gap exceeds ``largest_m``.

    Position and height are interpolated linearly, rotation by slerp. The points are those of both scans.

    Args:
        one: a scan and its pose.
        other: the next scan along the way.
        largest_m: largest distance between two places, metres; 0 puts no place between scans.

    Returns:
        The viewpoints from ``one`` to ``other``; none if the scans are near enough, or farther apart than ``FARTHEST_M``.
    """
    return [_viewpoint(one, other, share) for share in _shares(one.T_map_level, other.T_map_level, largest_m)]


def _shares(T_one: Transform, T_other: Transform, largest_m: float) -> Float64[NDArray[np.float64], " n"]:
    """Return the positions of the viewpoints on the way, 0 at the first scan and 1 at the second, without both ends."""
    apart_m = float(np.linalg.norm(T_other[:3, 3] - T_one[:3, 3]))
    if largest_m == 0 or apart_m > FARTHEST_M:
        return np.zeros(0)
    parts = max(1, int(np.ceil(apart_m / largest_m)))
    return np.arange(1, parts) / parts


def _viewpoint(one: PlacedScan, other: PlacedScan, share: float) -> Viewpoint:
    ends = np.stack([one.T_map_level, other.T_map_level])
    R_map_level = Slerp([0.0, 1.0], Rotation.from_matrix(ends[:, :3, :3]))(share).as_matrix()
    T_map_level = transform_from(R_map_level, (1 - share) * ends[0, :3, 3] + share * ends[1, :3, 3])
    height_m = (1 - share) * one.scan.level.height_m + share * other.scan.level.height_m
    points = np.concatenate([_moved(each, T_map_level) for each in (one, other)])
    return Viewpoint(T_map_level, height_m, points, principal_heading(points[:, :3], height_m=height_m))


def _moved(placed: PlacedScan, T_map_level: Transform) -> NDArray[np.float32]:
    """Return the points of a scan in the level frame of another pose."""
    points = placed.scan.points
    T_level_scan = inverse(T_map_level) @ placed.T_map_level
    moved = points.copy()
    moved[:, :3] = transform_points(T_level_scan, points[:, :3].astype(np.float64))
    return moved
