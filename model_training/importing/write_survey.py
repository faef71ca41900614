"""Write the survey of a dataset, scan by scan."""

from pathlib import Path

import numpy as np
from jaxtyping import Float32
from numpy.typing import NDArray

from model_training.datasets.dataset import scan_path, write_tum
from service.geometry.rigid import Transform


class SurveyWriter:
    """Number and write scans as they come. Poses are written at the end.

    Args:
        out: folder of the dataset.
    """

    def __init__(self, out: Path) -> None:
        self._out = out
        self._stamps: list[float] = []
        self._poses: list[Transform] = []
        scan_path(out, 0).parent.mkdir(parents=True, exist_ok=True)

    @property
    def count(self) -> int:
        """Number of scans so far."""
        return len(self._stamps)

    def add(self, stamp_s: float, T_map_lidar: Transform, points: Float32[NDArray[np.float32], "N 4"]) -> None:
        """Write a scan.

        Args:
            stamp_s: time, seconds.
            T_map_lidar: pose of the LiDAR (4, 4).
            points: x y z (m, LiDAR frame) and intensity.
        """
        scan_path(self._out, self.count).write_bytes(np.ascontiguousarray(points, np.float32).data)
        self._stamps.append(stamp_s)
        self._poses.append(T_map_lidar)

    def finish(self) -> None:
        """Write the poses."""
        write_tum(self._out / "survey" / "poses.txt", np.array(self._stamps), np.stack(self._poses))
