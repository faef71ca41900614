"""LiDAR odometry by KISS-ICP (Vizzo et al., RA-L 2023): poses of a drive from its scans alone."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model_training.importing.deskew import deskewed
from model_training.importing.recording import RecordedScan
from model_training.importing.trajectory import Trajectory
from service.geometry.rigid import Transform, inverse

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
    a pose is the one at the scan's stamp.
    """
    from kiss_icp.config import load_config
    from kiss_icp.kiss_icp import KissICP

    config = load_config(None)
    config.data.max_range, config.mapping.voxel_size, config.data.deskew = MAX_RANGE_M, VOXEL_M, False
    odometry = KissICP(config)
    last_s: float | None = None
    for scan in scans:
        points = scan.points
        if scan.offsets_s is not None and last_s is not None:
            delta = np.asarray(odometry.last_delta, np.float64)
            step_s = scan.stamp_s - last_s
            stamps = scan.stamp_s + step_s * np.array([-1.0, 0.0, 1.0])
            steady = Trajectory(stamps, np.stack([inverse(delta), np.eye(4), delta]), "constant speed")
            points = deskewed(scan, steady, np.eye(4))
        odometry.register_frame(points[:, :3].astype(np.float64), np.zeros(len(points)))
        last_s = scan.stamp_s
        yield PosedScan(scan.stamp_s, points, np.array(odometry.last_pose, np.float64))
