"""Poses that lie beside a recording, in a TUM file of their own."""

from pathlib import Path

import numpy as np

from model_training.datasets.dataset import read_tum
from model_training.importing.trajectory import Trajectory
from service.geometry.rigid import Transform


def read_pose_file(path: Path, *, T_vehicle_posed: Transform | None = None) -> Trajectory:
    """T_map_vehicle from a TUM file (timestamp x y z qx qy qz qw).

    Args:
        path: of the file.
        T_vehicle_posed: what the poses are of, where it is not the vehicle: a LiDAR or a camera on it.

    Raises:
        DatasetError: the file is missing or broken, or time does not rise in it.
    """
    stamps_s, T = read_tum(path)
    trajectory = Trajectory(stamps_s, T, str(path))
    return trajectory if T_vehicle_posed is None else trajectory.moved_by(np.asarray(T_vehicle_posed))
