"""A dataset whose survey left some streets out: what is asked there is asked outside the map."""

from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray

from model_training.datasets.dataset import Dataset, Transforms


class WithoutStreets(Dataset):
    """The dataset of a folder, less the scans of every ``each``-th street.

    Args:
        folder: of a dataset with streets.
        each: every which street is left out.
        first: the first one left out.
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
        """T_map_lidar of the scans that are left."""
        return super().survey_poses()[self._kept]

    def scan(self, number: int) -> NDArray[np.float32]:
        """Scan ``number`` of those that are left."""
        return super().scan(int(self._kept[number]))

    def is_outside(self, xy: NDArray[np.float64], *, away_m: float = 30.0) -> NDArray[np.bool_]:
        """Whether positions (n, 2) are further than that from every scan that is left."""
        apart = np.linalg.norm(xy[:, None] - self.survey_poses()[None, :, :2, 3], axis=2)
        return np.asarray(apart.min(axis=1) > away_m)
