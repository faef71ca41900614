"""Times by azimuth, and beams with angle errors."""

import numpy as np
import pytest

from model_training.importing.deskew import deskewed
from model_training.importing.spinning import period_of, raised, times_by_azimuth
from model_training.importing.trajectory import Trajectory
from service.geometry.rigid import rotation_z, transform_from


def scan(xyz):
    return np.c_[np.array(xyz, float), np.zeros(len(xyz))].astype(np.float32)


def test_a_turn_begins_at_the_rear_goes_over_the_left_and_faces_ahead_at_the_stamp():
    times = times_by_azimuth(scan([[-1, 1e-6, 0], [0, 1, 0], [1, 0, 0], [0, -1, 0], [-1, -1e-6, 0]]), period_s=0.1)
    np.testing.assert_allclose(times, [-0.05, -0.025, 0, 0.025, 0.05], atol=1e-6)


def test_a_ring_seen_from_a_moving_vehicle_is_round_again():
    """At ten metres per second in a bend, the vehicle sees each point of a round wall from its pose at that time."""
    stamps = np.linspace(-0.2, 0.2, 81)
    poses = np.stack([transform_from(rotation_z(0.5 * s), np.array([10.0 * s, 0, 0])) for s in stamps])
    trajectory = Trajectory(stamps, poses, "bend")
    seen = []
    for s in np.linspace(-0.049, 0.049, 400):
        azimuth = -2 * np.pi * s / 0.1
        T = trajectory.between(np.array([s]))[0]
        ray = T[:3, :3] @ [np.cos(azimuth), np.sin(azimuth), 0.0]
        b = T[:3, 3] @ ray  # where the ray meets the circle of 20 m about the origin
        seen.append((-b + np.sqrt(b * b - T[:3, 3] @ T[:3, 3] + 400)) * np.array([np.cos(azimuth), np.sin(azimuth), 0]))
    points = scan(seen)
    from model_training.importing.recording import RecordedScan

    recorded = RecordedScan("0", 0.0, points, times_by_azimuth(points, period_s=0.1))
    at_rest = deskewed(recorded, trajectory, np.eye(4))
    assert np.abs(np.linalg.norm(points[:, :3], axis=1) - 20).max() > 0.4
    assert np.abs(np.linalg.norm(at_rest[:, :3], axis=1) - 20).max() < 0.02


def test_raised_points_keep_range_azimuth_and_intensity():
    rng = np.random.default_rng(3)
    points = scan(rng.uniform(-30, 30, (200, 3)))
    moved = raised(points, 0.205)
    np.testing.assert_allclose(np.linalg.norm(moved[:, :3], axis=1), np.linalg.norm(points[:, :3], axis=1), rtol=1e-5)
    np.testing.assert_allclose(np.arctan2(moved[:, 1], moved[:, 0]), np.arctan2(points[:, 1], points[:, 0]), atol=1e-5)
    up = [np.rad2deg(np.arctan2(p[:, 2], np.hypot(p[:, 0], p[:, 1]))) for p in (points, moved)]
    np.testing.assert_allclose(up[1] - up[0], 0.205, atol=1e-3)
    assert raised(points, 0.0) is points
    assert np.isfinite(raised(scan([[0, 0, 1], [0, 0, 0]]), 0.205)).all()


@pytest.mark.parametrize(("steps", "period_s"), [(0.1033, 0.1033), (0.6, 0.1), (0.001, 0.1)])
def test_the_period_is_that_of_the_stamps_if_they_are_of_consecutive_turns(steps, period_s):
    assert period_of(np.arange(9) * steps, otherwise_s=0.1) == pytest.approx(period_s)
    assert period_of(np.array([3.0]), otherwise_s=0.1) == 0.1
