"""Read poses from a TUM file beside a recording."""

from pathlib import Path

import numpy as np

from model_training.datasets.dataset import read_tum
from model_training.importing.trajectory import Trajectory
from service.geometry.rigid import Transform


def read_pose_file(path: Path, *, T_vehicle_posed: Transform | None = None) -> Trajectory:
    """Read T_map_vehicle from a TUM file (timestamp x y z qx qy qz qw).

    Args:
        path: of the file.
        T_vehicle_posed: mounting of what the poses belong to, such as a LiDAR or a camera (4, 4). None for the vehicle.

    Raises:
        DatasetError: the file is missing or broken, or its times do not rise.
    """
    stamps_s, T = read_tum(path)
    trajectory = Trajectory(stamps_s, T, str(path))
    return trajectory if T_vehicle_posed is None else trajectory.moved_by(np.asarray(T_vehicle_posed))
