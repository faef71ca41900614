"""Height up to which the survey saw surfaces."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from model_training.mapping.cloud import SURVEYED_HEIGHT, surveyed_height_m, with_cloud
from model_training.mapping.stored_map import content_of
from model_training.mapping.voxel_map import VoxelMap
from service.maps.reader import MapBundle


def cloud_of(xyz: NDArray[np.float64]) -> Any:
    """Return points as a cloud with its origin at x = 100 m."""
    surfels = np.zeros(len(xyz), [("xyz", np.float64, 3)])
    surfels["xyz"] = xyz - np.array([100.0, 0.0, 0.0])
    return SimpleNamespace(surfels=surfels, origin_m=np.array([100.0, 0.0, 0.0]), unpacked=lambda rows: surfels[rows])


def content_at(*places_m: tuple[float, float, float], lidar_height_m: float = 2.0) -> Any:
    T = np.tile(np.eye(4), (len(places_m), 1, 1))
    T[:, :3, 3] = np.array(places_m, float).reshape(-1, 3)
    return SimpleNamespace(T_map_place=T, parameters={"lidar_height_m": lidar_height_m})


def wall(x_m: float, ground_m: float) -> NDArray[np.float64]:
    """Return a wall whose points stand 0 to 10 m above its ground, every centimetre."""
    heights = np.arange(0, 10.005, 0.01)
    return np.c_[np.full(len(heights), x_m), np.full(len(heights), 3.0), heights + ground_m]


def test_the_height_of_a_wall_is_counted_from_the_ground_under_the_nearest_place() -> None:
    """Of 0.3 to 10 m, 99.9 % lie below 9.99 m, and the rim is 0.5 m. The second wall stands on a hill of 50 m, with a place of its own."""
    cloud = cloud_of(np.concatenate([wall(0.0, 0.0), wall(200.0, 50.0)]))
    content = content_at((0.0, 0.0, 2.0), (200.0, 0.0, 52.0))
    assert surveyed_height_m(cloud, content) == pytest.approx(10.49, abs=0.015)


def test_far_surfels_and_the_ground_do_not_count() -> None:
    far = np.array([[60.0, 0.0, 30.0]] * 2000)
    ground = np.array([[1.0, 1.0, 0.05]] * 50_000)
    cloud = cloud_of(np.concatenate([wall(0.0, 0.0), far, ground]))
    assert surveyed_height_m(cloud, content_at((0.0, 0.0, 2.0))) == pytest.approx(10.49, abs=0.015)


def test_without_surfels_beside_a_place_there_is_no_height() -> None:
    assert surveyed_height_m(cloud_of(wall(500.0, 0.0)), content_at((0.0, 0.0, 2.0))) is None
    assert surveyed_height_m(cloud_of(wall(0.0, 0.0)), content_at()) is None


def test_a_map_states_the_height_of_its_own_cloud(small_map: Path) -> None:
    bundle = MapBundle.open(small_map)
    height_m = bundle.manifest.surveyed_height_m
    assert height_m is not None
    assert 2.0 < height_m < 20.0
    content = content_of(bundle)
    earlier = replace(content, parameters={**content.parameters, SURVEYED_HEIGHT: 99.0})
    empty = with_cloud(earlier, VoxelMap(0.3, np.zeros(3)))
    assert SURVEYED_HEIGHT not in empty.parameters
