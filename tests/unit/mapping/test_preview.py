"""The picture of a map from above, pixel by pixel."""

import cv2
import numpy as np
import pytest

from model_training.mapping import voxel_map
from model_training.mapping.preview import preview_webp
from service.registration.kernel import SURFEL
from service.registration.surfel_map import SurfelMap


def surfels_of(xyz, normal):
    found = np.zeros(len(xyz), SURFEL)
    found["xyz"], found["normal"] = xyz, normal
    return found


def decoded(picture):
    return cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_GRAYSCALE)


@pytest.fixture
def street():
    """Ground of 40 x 20 m with a point every half metre, a wall along y = 15 m, and a track along y = 5 m."""
    x, y = (each.ravel() for each in np.meshgrid(np.arange(0, 40, 0.5), np.arange(0, 20, 0.5)))
    ground = surfels_of(np.c_[x, y, 0 * x], (0, 0, 1))
    wall = surfels_of(np.repeat(np.c_[np.arange(0, 40, 0.2), np.full(200, 15.0), np.ones(200)], 12, axis=0), (0, 1, 0))
    return np.concatenate([ground, wall]), np.c_[np.arange(0, 40, 5.0), np.full(8, 5.0), np.ones(8)]


def test_walls_are_dark_and_ground_is_light(street):
    """The picture has 2 px per metre, and a rim of 5 m: y = 15 m is 5 m + 5 m below its upper edge of 25 m."""
    surfels, track = street
    cloud = SurfelMap.prepare(np.array([100.0, 50.0, 0.0]), surfels)
    found = decoded(preview_webp(cloud, track + [100.0, 50.0, 0.0], longest_px=100))
    assert found.shape == (60, 101)
    wall, ground, rim = found[38:42, 30:70].min(), np.median(found[12:28, 30:70]), found[2, 2]
    assert wall < 150 < ground < rim


def test_parts_give_the_same_picture(street, monkeypatch):
    cloud, track = SurfelMap.prepare(np.zeros(3), street[0]), street[1]
    once = preview_webp(cloud, track)
    monkeypatch.setattr(voxel_map, "_PART", 100)
    assert preview_webp(cloud, track) == once


def test_a_map_without_a_cloud_shows_the_track():
    found = decoded(preview_webp(None, np.array([[0.0, 0, 0], [20.0, 0, 0]])))
    assert found.min() < 200
