from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from model_training.datasets.dataset import LidarSensor
from model_training.importing.recording import Event, Notes, RecordedScan
from model_training.importing.trajectory import Trajectory
from service.geometry.rigid import inverse, rotation_z, transform_from, transform_points

#: Half the sides of a hall, its floor 1.8 m below the LiDAR.
HALF_X, HALF_Y, FLOOR, CEILING = 16.0, 9.0, -1.8, 4.0


def hall(rng: np.random.Generator) -> np.ndarray:
    """Return points of floor, walls and pillars, map frame."""
    n = 1500
    x, y, z = rng.uniform(-HALF_X, HALF_X, n), rng.uniform(-HALF_Y, HALF_Y, n), rng.uniform(FLOOR, CEILING, n)
    surfaces = [np.c_[x, y, np.full(n, FLOOR)]]
    surfaces += [np.c_[x, np.full(n, side * HALF_Y), z] for side in (-1, 1)]
    surfaces += [np.c_[np.full(n, side * HALF_X), y, z] for side in (-1, 1)]
    for at_x, at_y in ((-9, 5), (-3, -6), (2, 6), (7, -4), (11, 3)):
        angle = rng.uniform(0, 2 * np.pi, 300)
        surfaces.append(np.c_[at_x + 0.6 * np.cos(angle), at_y + 0.6 * np.sin(angle), rng.uniform(FLOOR, CEILING, 300)])
    return np.concatenate(surfaces)


def pose_at(stamp_s: float) -> np.ndarray:
    """Return the pose at a time: 3 m/s along the hall, with a slow rotation."""
    return transform_from(rotation_z(0.1 * stamp_s), np.array([-6.0 + 3.0 * stamp_s, 0.5 * stamp_s, 0.0]))


@dataclass
class HallDrive:
    """Scans of a hall, ten per second, 0.3 m apart."""

    count_of_scans: int = 15
    moving: bool = False
    lidar: LidarSensor = field(default_factory=lambda: LidarSensor(name="hall", T_vehicle_sensor=np.eye(4).tolist()))
    kind: str = "hall"
    notes: Notes = field(default_factory=Notes)
    georeference: dict[str, Any] | None = None
    has_images: bool = False

    def count(self) -> int:
        return self.count_of_scans

    def trajectory(self) -> Trajectory | None:
        return None

    @property
    def truth(self) -> np.ndarray:
        """Return T_first_lidar of every scan."""
        return np.stack([inverse(pose_at(0.0)) @ pose_at(0.1 * k) for k in range(self.count_of_scans)])

    def events(self, *, pictures: bool = True) -> Iterator[Event]:
        del pictures  # there are none
        rng = np.random.default_rng(0)
        for k in range(self.count_of_scans):
            points_map, stamp_s = hall(rng), 0.1 * k
            if not self.moving:
                offsets, points = None, transform_points(inverse(pose_at(stamp_s)), points_map)
            else:  # the LiDAR sweeps round once from the stamp on
                steps = np.round(40 * (np.arctan2(points_map[:, 1], points_map[:, 0]) / (2 * np.pi) + 0.5)).astype(int)
                T = np.stack([inverse(pose_at(stamp_s + 0.0025 * step)) for step in range(41)])[steps]
                offsets, points = 0.0025 * steps, np.einsum("nij,nj->ni", T[:, :3, :3], points_map) + T[:, :3, 3]
            yield RecordedScan(f"{k}", stamp_s, np.c_[points, np.zeros(len(points))].astype(np.float32), offsets)


@pytest.fixture(scope="session")
def hall_drive() -> Callable[..., HallDrive]:
    return HallDrive
