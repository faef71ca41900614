import numpy as np
import pytest

from model_training.importing.deskew import deskewed, times_fit
from model_training.importing.trajectory import Trajectory
from service.geometry.rigid import inverse, rotation_z, transform_from, transform_points

T_VEHICLE_LIDAR = transform_from(rotation_z(0.4), np.array([0.5, -0.2, 1.8]))


def pose_at(s):
    """Return the pose at a time for 15 m/s and a bend of 0.6 rad/s, in closed form."""
    speed, turn = 15.0, 0.6
    at = np.array([np.sin(turn * s), 1 - np.cos(turn * s), 0.0]) * speed / turn
    return transform_from(rotation_z(turn * s), at)


def bend(rate_hz=200.0):
    stamps = np.arange(0, 2, 1 / rate_hz)
    return Trajectory(stamps, np.stack([pose_at(s) for s in stamps]), "bend")


def test_points_of_a_turning_vehicle_come_to_rest_where_they_are(scan_at):
    rng = np.random.default_rng(1)
    points_map = rng.uniform(-30, 30, (400, 3))
    offsets = np.linspace(-0.05, 0.05, 400)
    seen = [
        transform_points(inverse(pose_at(1.0 + o) @ T_VEHICLE_LIDAR), p[None])[0]
        for o, p in zip(offsets, points_map, strict=True)
    ]
    scan = scan_at(1.0, points=np.c_[seen, np.arange(400)], offsets_s=offsets)
    at_rest = deskewed(scan, bend(), T_VEHICLE_LIDAR)
    expected = transform_points(inverse(pose_at(1.0) @ T_VEHICLE_LIDAR), points_map)
    assert np.abs(scan.points[:, :3] - expected).max() > 0.5
    assert np.abs(at_rest[:, :3] - expected).max() < 0.025  # a millisecond's step
    np.testing.assert_array_equal(at_rest[:, 3], scan.points[:, 3])


def test_a_scan_is_left_as_it_was_and_its_own_moment_does_not_move(scan_at):
    points = np.ones((3, 4), np.float32)
    scan = scan_at(1.0, points=points, offsets_s=[0.0, 0.0, 0.04])
    moved = deskewed(scan, bend(), T_VEHICLE_LIDAR)
    np.testing.assert_array_equal(scan.points, points)
    np.testing.assert_allclose(moved[:2], points[:2], atol=1e-5)
    assert np.linalg.norm(moved[2, :3] - points[2, :3]) > 0.4


def test_a_scan_without_times_comes_back_untouched(scan_at):
    scan = scan_at(1.0)
    assert deskewed(scan, bend(), T_VEHICLE_LIDAR) is scan.points


@pytest.mark.parametrize(
    ("offsets", "fit"), [([-0.1, 0.0], True), ([0.0, 523.0], False), ([0.0, np.nan], False), (None, True)]
)
def test_times_of_another_clock_are_known_as_such(scan_at, offsets, fit):
    scan = scan_at(1.0, points=np.ones((2, 4)), offsets_s=offsets)
    assert times_fit(scan) == fit
