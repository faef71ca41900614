"""LiDAR odometry: poses of a traversal from its scans alone.

KISS-ICP (Vizzo et al., RA-L 2023) finds each scan robustly, point to point. Then small_gicp (Koide, JOSS 2024) aligns
the scan to a voxel map of distributions. This second step sees pitch and roll of the vehicle.
On a simulated traversal it reduced the rotation error per step from 0.37 to 0.02 degrees. The height error after 500 m
fell from 9 to 0.1 m (decision 0057).
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model_training.importing.deskew import deskewed
from model_training.importing.recording import RecordedScan
from model_training.importing.trajectory import Trajectory
from service.geometry.rigid import Transform, inverse, transform_points

#: Greatest range of a point, metres.
MAX_RANGE_M = 100.0
#: Voxel size of KISS-ICP, metres: half of the package's default, because we map streets and not motorways.
VOXEL_M = 0.5
#: small_gicp: cell size that keeps one point of a scan, metres, and neighbours that define a point's surface.
FINE_CELL_M, NEIGHBOURS = 0.3, 12
#: Cell size of the map that scans are aligned to, and greatest distance of a correspondence, metres.
MAP_CELL_M, REACH_M = 0.7, 1.0
#: Distance travelled between scans that enter the map, metres. Cells that are unused for 100 insertions are removed.
INSERT_M, FORGET_AFTER = 0.5, 100
#: Greatest correction of a KISS-ICP pose, metres. A larger one is probably a wrong match and is not applied.
MOST_M = 1.0


@dataclass(frozen=True, slots=True)
class PosedScan:
    """A scan with its pose from odometry.

    Attributes:
        stamp_s: time of the scan, seconds.
        points: x y z (m) and intensity (N, 4), LiDAR frame at ``stamp_s``.
        T_first_lidar: pose at ``stamp_s``, in the LiDAR frame of the first scan.
    """

    stamp_s: float
    points: NDArray[np.float32]
    T_first_lidar: Transform


def posed(scans: Iterable[RecordedScan]) -> Iterator[PosedScan]:
    """Yield scans with their poses in the frame of the first scan, one at a time.

    ``deskewed`` removes the motion within a turn, with the speed of the turn before. KISS-ICP's own de-skew is off, so that
    a pose belongs to the scan's stamp.
    Points are registered as at the middle of the turn. There an error of the speed distorts both halves in opposite
    directions, but does not move the scan. At the begin of the turn it would move the pose by half of the error, and the
    next speed by all of it. Then poses would oscillate from scan to scan.

    Args:
        scans: in order of time.
    """
    from kiss_icp.config import load_config
    from kiss_icp.kiss_icp import KissICP

    config = load_config(None)
    config.data.max_range, config.mapping.voxel_size, config.data.deskew = MAX_RANGE_M, VOXEL_M, False
    coarse, fine = KissICP(config), FineMap()
    last_s: float | None = None
    for scan in scans:
        middle = _at_its_middle(scan)
        points, step_s = middle.points, 0.0 if last_s is None else middle.stamp_s - last_s
        if step_s > 0:
            points = deskewed(middle, _steady(coarse.last_delta, middle.stamp_s, step_s), np.eye(4))
        xyz = points[:, :3].astype(np.float64)
        coarse.register_frame(xyz, np.zeros(len(points)))
        last_s = middle.stamp_s
        T_first_middle = fine.aligned(xyz, np.array(coarse.last_pose, np.float64))
        if scan.offsets_s is None or step_s <= 0:
            yield PosedScan(scan.stamp_s, points, T_first_middle)
            continue
        T_middle_stamp = _steady(coarse.last_delta, middle.stamp_s, step_s).between(np.array([scan.stamp_s]))[0]
        at_stamp = points.copy()
        at_stamp[:, :3] = transform_points(inverse(T_middle_stamp), xyz)
        yield PosedScan(scan.stamp_s, at_stamp, T_first_middle @ T_middle_stamp)


def _at_its_middle(scan: RecordedScan) -> RecordedScan:
    """The scan with the time of the middle of its turn as its stamp."""
    if scan.offsets_s is None or not len(scan.offsets_s):
        return scan
    middle_s = float(scan.offsets_s.min() + scan.offsets_s.max()) / 2
    return replace(scan, stamp_s=scan.stamp_s + middle_s, offsets_s=scan.offsets_s - middle_s)


def _steady(delta: NDArray[np.float64], stamp_s: float, step_s: float) -> Trajectory:
    """Motion at constant speed relative to the pose at ``stamp_s``: ``delta`` per ``step_s``."""
    stamps = stamp_s + step_s * np.array([-1.0, 0.0, 1.0])
    return Trajectory(stamps, np.stack([inverse(delta), np.eye(4), delta]), "constant speed")


class FineMap:
    """Distributions of the points around the vehicle, and the pose of the last scan. The first scan keeps its given pose."""

    def __init__(self) -> None:
        import small_gicp

        self._package: Any = small_gicp
        self._map = small_gicp.GaussianVoxelMap(MAP_CELL_M)
        self._map.set_lru(horizon=FORGET_AFTER, clear_cycle=10)
        self._T = np.eye(4)
        self._T_coarse: Transform | None = None
        self._inserted_m: NDArray[np.float64] | None = None

    def aligned(self, xyz: NDArray[np.float64], T_coarse: Transform) -> Transform:
        """Align a scan whose pose is approximately known, and add it to the map if the vehicle has moved.

        Args:
            xyz: points of the scan (N, 3), LiDAR frame, metres.
            T_coarse: approximate pose; only its change since the last call matters, except in the first call.

        Returns:
            T_first_lidar. It is the initial guess if the alignment does not converge or moves it more than ``MOST_M``.
        """
        near = xyz[np.linalg.norm(xyz, axis=1) < MAX_RANGE_M]
        cloud, _ = self._package.preprocess_points(
            near, downsampling_resolution=FINE_CELL_M, num_neighbors=NEIGHBOURS, num_threads=1
        )
        if self._T_coarse is not None:
            guess = self._T @ inverse(self._T_coarse) @ T_coarse
            found = self._package.align(self._map, cloud, guess, max_correspondence_distance=REACH_M, num_threads=1)
            T = np.asarray(found.T_target_source, np.float64)
            moved_m = float(np.linalg.norm(T[:3, 3] - guess[:3, 3]))
            self._T = T if found.converged and moved_m <= MOST_M else guess
        else:
            self._T = T_coarse
        self._T_coarse = T_coarse
        if self._inserted_m is None or np.linalg.norm(self._T[:3, 3] - self._inserted_m) >= INSERT_M:
            self._map.insert(cloud, self._T)
            self._inserted_m = self._T[:3, 3].copy()
        return self._T.copy()
