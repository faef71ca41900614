"""LiDAR odometry by KISS-ICP (Vizzo et al., RA-L 2023): poses of a drive from its scans alone."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from model_training.importing.deskew import deskewed
from model_training.importing.recording import RecordedScan
from model_training.importing.trajectory import Trajectory
from service.geometry.rigid import Transform, inverse, transform_points

MAX_RANGE_M = 100.0
#: Half of the package's own default: streets, not motorways.
VOXEL_M = 0.5


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
    odometry = KissICP(config)
    last_s: float | None = None
    for scan in scans:
        middle = _at_its_middle(scan)
        points, step_s = middle.points, 0.0 if last_s is None else middle.stamp_s - last_s
        if step_s > 0:
            points = deskewed(middle, _steady(odometry.last_delta, middle.stamp_s, step_s), np.eye(4))
        odometry.register_frame(points[:, :3].astype(np.float64), np.zeros(len(points)))
        last_s = middle.stamp_s
        T_first_middle = np.array(odometry.last_pose, np.float64)
        if scan.offsets_s is None or step_s <= 0:
            yield PosedScan(scan.stamp_s, points, T_first_middle)
            continue
        T_middle_stamp = _steady(odometry.last_delta, middle.stamp_s, step_s).between(np.array([scan.stamp_s]))[0]
        at_stamp = points.copy()
        at_stamp[:, :3] = transform_points(inverse(T_middle_stamp), points[:, :3].astype(np.float64))
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
