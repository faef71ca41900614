"""A small dataset in which we chose every number."""

from pathlib import Path

import numpy as np
import pytest

from model_training.datasets.dataset import (
    CameraSensor,
    Dataset,
    DatasetDescription,
    DepthSpec,
    LidarSensor,
    Sensors,
    query_folder,
    scan_path,
    write_description,
    write_tum,
)
from model_training.datasets.png import write_png
from service.geometry.rigid import R_BODY_OPTICAL, rotation_x, rotation_z, transform_from

T_LIDAR = transform_from(rotation_z(0.3) @ rotation_x(0.02), np.array([0.4, -0.1, 1.8]))
T_CAMERA = transform_from(rotation_z(-0.1) @ R_BODY_OPTICAL, np.array([1.2, 0.3, 1.4]))


def make_dataset(
    folder: Path, *, scans: int = 4, frames: int = 3, scale_m: float = 0.001, queries: bool = True
) -> Dataset:
    rng = np.random.default_rng(2)

    def pose(k: float) -> np.ndarray:
        return transform_from(rotation_z(0.2 * k), np.array([1.5 * k, 0.25 * k, 0.0]))

    stamps = 1_700_000_000 + 0.1 * np.arange(scans, dtype=np.float64)
    scan_path(folder, 0).parent.mkdir(parents=True)
    for k in range(scans):
        points = rng.uniform(0, 30, (50 + k, 4)).astype(np.float32)
        scan_path(folder, k).write_bytes(points.data)
    write_tum(folder / "survey" / "poses.txt", stamps, np.stack([pose(k) @ T_LIDAR for k in range(scans)]))
    camera = CameraSensor(
        name="front",
        width=8,
        height=6,
        fx=7.5,
        fy=7.25,
        cx=3.5,
        cy=2.75,
        depth=DepthSpec(scale_m=scale_m),
        T_vehicle_sensor=T_CAMERA.tolist(),
    )
    if queries:
        where = query_folder(folder, "drive")
        for k in range(frames):
            write_png(where / "rgb" / f"{k:06d}.png", rng.integers(0, 256, (6, 8, 3), dtype=np.uint8))
            write_png(where / "depth" / f"{k:06d}.png", rng.integers(0, 60_000, (6, 8)).astype(np.uint16))
        write_tum(where / "poses.txt", stamps[:frames], np.stack([pose(k + 0.5) @ T_CAMERA for k in range(frames)]))
    lidar = LidarSensor(name="lidar", T_vehicle_sensor=T_LIDAR.tolist())
    sensors = Sensors(lidars=[lidar], cameras=[camera] if queries else [])
    write_description(folder, DatasetDescription(name="little", source={"kind": "test"}, sensors=sensors))
    return Dataset(folder)


@pytest.fixture(scope="session")
def dataset_in() -> object:
    return make_dataset


@pytest.fixture
def dataset(tmp_path: Path) -> Dataset:
    return make_dataset(tmp_path / "little")
