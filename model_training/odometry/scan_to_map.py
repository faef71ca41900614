"""LiDAR odometry: poses of a drive from its scans alone.

KISS-ICP (Vizzo et al., RA-L 2023) finds each scan robustly, point to point; small_gicp (Koide, JOSS 2024) then aligns it to a voxel
map of distributions, which sees how the vehicle pitches and rolls: on a simulated drive that took the error of a step's
rotation from 0.37 to 0.02 degrees, and what is left of height after 500 m from 9 to 0.1 m.
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

MAX_RANGE_M = 100.0
#: KISS-ICP's voxels: half of the package's own default, for streets, not motorways.
VOXEL_M = 0.5
#: Points of a scan that are aligned: one in so large a cell; each one's surface is that of so many neighbours.
FINE_CELL_M, NEIGHBOURS = 0.3, 12
#: The map that they are aligned to, and how far a point may be from it.
MAP_CELL_M, REACH_M = 0.7, 1.0
#: A scan goes into that map after so much travel; what has not been met for so many scans is forgotten.
INSERT_M, FORGET_AFTER = 0.5, 100
#: The alignment may not move a scan further than that from where KISS-ICP has it: it would be another street.
MOST_M = 1.0


@dataclass(frozen=True, slots=True)
class PosedScan:
    """A scan, its points at its own moment, and T_first_lidar by odometry."""

    stamp_s: float
    points: NDArray[np.float32]
    T_first_lidar: Transform


def posed(scans: Iterable[RecordedScan]) -> Iterator[PosedScan]:
    """Scans with their poses in the frame of the first one, one at a time.

    The motion within a turn is taken out with the speed of the turn before it, by ``deskewed``, not by the package, so that
    a pose is the one at the scan's stamp. What is registered are the points as at the turn's middle: there an error of the
    speed pulls its two halves apart but moves the whole nowhere; as at its begin it moves the pose by half of itself, the next
    speed by the whole, and poses swing from scan to scan without end.
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
    """The scan with the time halfway through its turn for its stamp."""
    if scan.offsets_s is None or not len(scan.offsets_s):
        return scan
    middle_s = float(scan.offsets_s.min() + scan.offsets_s.max()) / 2
    return replace(scan, stamp_s=scan.stamp_s + middle_s, offsets_s=scan.offsets_s - middle_s)


def _steady(delta: NDArray[np.float64], stamp_s: float, step_s: float) -> Trajectory:
    """Motion at constant speed, against where it is at ``stamp_s``: ``delta`` in each ``step_s``."""
    stamps = stamp_s + step_s * np.array([-1.0, 0.0, 1.0])
    return Trajectory(stamps, np.stack([inverse(delta), np.eye(4), delta]), "constant speed")


class FineMap:
    """Distributions of the points around the vehicle, and where the last scan was found in them; the first one stays where it is given."""

    def __init__(self) -> None:
        import small_gicp

        self._package: Any = small_gicp
        self._map = small_gicp.GaussianVoxelMap(MAP_CELL_M)
        self._map.set_lru(horizon=FORGET_AFTER, clear_cycle=10)
        self._T = np.eye(4)
        self._T_coarse: Transform | None = None
        self._inserted_m: NDArray[np.float64] | None = None

    def aligned(self, xyz: NDArray[np.float64], T_coarse: Transform) -> Transform:
        """T_first_lidar of a scan whose pose is roughly known."""
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
