"""A room whose walls make every pose unique: a part of it, moved by a known pose, must be registered."""

import sys

import numpy as np
import pytest

from research.baselines.cloud_registration import (
    REACH_M,
    GicpMap,
    by_kiss_matcher,
    points_of_depth,
    thinned_to_voxels,
)
from service.errors import ExtraMissingError
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import inverse, rotation_z, transform_from, transform_points


def corner(seed=0):
    """Return ground, two walls that intersect, and boxes beside them."""
    rng = np.random.default_rng(seed)
    u, v = rng.uniform(0, 20, (2, 6000))
    walls = [np.stack([u, v, 0 * u], 1), np.stack([u, 0 * u, v / 4], 1), np.stack([0 * u, u, v / 4], 1)]
    for _ in range(8):
        low = rng.uniform(2, 17, 3) * [1, 1, 0]
        walls.append(low + rng.uniform(0, 1, (400, 3)) * [rng.uniform(0.5, 3), 0.05, rng.uniform(1, 4)])
    return np.concatenate(walls)


def test_a_voxel_keeps_the_mean_of_its_points():
    points = np.array([[0.1, 0.1, 0.1], [0.3, 0.1, 0.1], [1.2, 0.0, 0.0]])
    np.testing.assert_allclose(thinned_to_voxels(points, 1.0), [[0.2, 0.1, 0.1], [1.2, 0.0, 0.0]])


def test_depth_is_back_projected_up_to_the_reach():
    """The middle of three pixels looks straight ahead, the others one focal length to each side. The last is too far."""
    camera = PinholeCamera(3, 1, 1.0, 1.0, 1.0, 0.0)
    depth_m = np.array([[2.0, 3.0, REACH_M + 1]], np.float32)
    np.testing.assert_allclose(points_of_depth(depth_m, camera), [[-2.0, 0.0, 2.0], [0.0, 0.0, 3.0]])


def test_gicp_moves_a_near_guess_to_the_pose():
    pytest.importorskip("small_gicp")
    T = transform_from(rotation_z(0.4), np.array([6.0, 5.0, 1.0]))
    points = transform_points(inverse(T), corner())
    guess = T @ transform_from(rotation_z(0.05), np.array([0.4, -0.3, 0.1]))
    found = GicpMap(corner()).locate(points, guess)
    np.testing.assert_allclose(found[:3, 3], T[:3, 3], atol=0.05)


def test_kiss_matcher_finds_the_pose_without_a_guess():
    pytest.importorskip("kiss_matcher")
    T = transform_from(rotation_z(1.9), np.array([6.0, 5.0, 1.0]))
    found = by_kiss_matcher(transform_points(inverse(T), corner()), corner())
    assert found is not None
    np.testing.assert_allclose(found[:3, 3], T[:3, 3], atol=0.5)  # a voxel


def test_a_missing_library_is_named_with_what_installs_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "kiss_matcher", None)
    with pytest.raises(ExtraMissingError, match="pip install") as missing:
        by_kiss_matcher(corner(), corner())
    assert missing.value.field == "kiss_matcher"
