"""A dataset whose survey lacks some streets. Queries on these streets are out-of-map queries."""

from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray

from model_training.datasets.dataset import Dataset, Transforms


class WithoutStreets(Dataset):
    """The dataset of a folder without the scans of every ``each``-th street.

    Args:
        folder: folder of a dataset with streets.
        each: interval of the removed streets in the sorted list of names.
        first: index of the first removed street.

    Attributes:
        removed: names of the removed streets.

    Raises:
        DatasetError: ``dataset.json``, the streets or the poses are missing or damaged.
    """

    def __init__(self, folder: Path, *, each: int = 3, first: int = 0) -> None:
        super().__init__(folder)
        streets = self.streets() or {"features": []}
        names = sorted({feature["properties"]["street"] for feature in streets["features"]})
        self.removed = set(names[first::each])
        shapes = [
            shapely.geometry.shape(feature["geometry"])
            for feature in streets["features"]
            if feature["properties"]["street"] in self.removed
        ]
        points = shapely.points(super().survey_poses()[:, :2, 3])
        self._kept = np.flatnonzero(~shapely.contains(shapely.union_all(shapes), points))

    def survey_poses(self) -> Transforms:
        """Return T_map_lidar of the remaining scans (n, 4, 4), metres.

        Raises:
            DatasetError: the pose file is missing or damaged.
        """
        return super().survey_poses()[self._kept]

    def scan(self, number: int) -> NDArray[np.float32]:
        """Return a scan (n, 4): x, y, z in the LiDAR frame (m) and intensity.

        Args:
            number: number of the scan among the remaining scans.

        Raises:
            DatasetError: the file is missing, truncated or cannot be read.
        """
        return super().scan(int(self._kept[number]))

    def is_outside(self, xy: NDArray[np.float64], *, away_m: float = 30.0) -> NDArray[np.bool_]:
        """Return whether each position (n,) is outside the map: farther than a distance from every remaining scan.

        Args:
            xy: positions (n, 2), map frame, metres.
            away_m: the distance, metres.
        """
        apart = np.linalg.norm(xy[:, None] - self.survey_poses()[None, :, :2, 3], axis=2)
        return np.asarray(apart.min(axis=1) > away_m)
