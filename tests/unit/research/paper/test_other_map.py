"""The paper's network on another map, with small images in place of features."""

from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from research.baselines.paper import other_map
from research.baselines.paper.other_map import nearest_scans
from service.geometry.camera import PinholeCamera

CAMERA = PinholeCamera(160, 120, 80.0, 80.0, 79.5, 59.5)
LIDAR_M, CAMERA_M, FAR_M = 1.8, 1.5, 30.0


def scan_of(ahead_m, behind_m):
    """Return a scan between two flat walls across the street, on level ground."""
    azimuth, elevation = np.meshgrid(np.deg2rad(np.arange(-180, 180, 0.4)), np.deg2rad(np.arange(-24, 24, 0.5)))
    ray = np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], -1)
    x = ray[..., 0]
    wall = np.where(x > 0, ahead_m / np.maximum(x, 1e-6), behind_m / np.maximum(-x, 1e-6))
    ground = np.where(ray[..., 2] < 0, LIDAR_M / np.maximum(-ray[..., 2], 1e-6), np.inf)
    ranges = np.minimum(wall, ground)[..., None]
    points = np.concatenate([ray * ranges, np.full_like(ranges, 0.5)], -1).reshape(-1, 4)
    return points[ranges.ravel() < FAR_M].astype(np.float32)


def pair_before(wall_m) -> Any:
    """Return an image pair of a camera that looks at a wall straight ahead."""
    rays = CAMERA.rays_of_pixels()
    ground = np.where(rays[..., 1] > 0, CAMERA_M / np.maximum(rays[..., 1], 1e-6), np.inf)
    depth = np.minimum(ground, wall_m).astype(np.float32)
    grey = np.full((120, 160, 3), 90, np.uint8)
    return SimpleNamespace(rgb=lambda: grey, depth_m=lambda: depth, camera=SimpleNamespace(pinhole=lambda: CAMERA))


class Survey:
    def __init__(self, *walls):
        self.walls = walls

    def survey_poses(self):
        T = np.tile(np.eye(4), (len(self.walls), 1, 1))
        T[:, 0, 3] = 10.0 * np.arange(len(self.walls))
        return T

    def scan(self, number):
        return scan_of(*self.walls[number])


def located(survey: Any, *pairs: Any) -> Any:
    network: Any = None
    return nearest_scans(network, survey, pairs).tolist()


@pytest.fixture(autouse=True)
def _images_as_features(monkeypatch):
    def outputs(_net, drawn, count):
        small = [
            cv2.resize(each, (14, 14), interpolation=cv2.INTER_AREA).mean(axis=2) for each in drawn(np.arange(count))
        ]
        return np.array(small, np.float32).reshape(count, -1), np.zeros((count, 16), np.float32)

    monkeypatch.setattr(other_map, "outputs", outputs)


def test_each_pair_gets_the_scan_with_the_nearest_features():
    survey = Survey((6.0, 25.0), (12.0, 25.0), (18.0, 25.0))
    found = located(survey, pair_before(12.0), pair_before(6.0), pair_before(18.0))
    assert found == [[10.0, 0.0], [0.0, 0.0], [20.0, 0.0]]


def test_a_camera_that_looks_against_the_survey_is_found_too():
    survey = Survey((25.0, 20.0), (25.0, 6.0), (25.0, 14.0))
    assert located(survey, pair_before(6.0)) == [[10.0, 0.0]]
