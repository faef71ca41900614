"""Odometry in a hall with known poses, loops by rotated descriptors, and a pose graph on a square."""

from typing import Any

import numpy as np
import pytest

from model_training.odometry.find import find_trajectory
from model_training.odometry.keyframes import Keyframe, OdometryTrajectory, drive_of
from model_training.odometry.loops import Loop, LoopSettings, all_round, find_loops
from model_training.odometry.pose_graph import closed, disagreement_m
from model_training.odometry.scan_to_map import posed
from service.errors import DatasetError
from service.geometry.rigid import inverse, rotation_z, transform_from

pytest.importorskip("gtsam", reason="needs the extra `mapping`")
pytest.importorskip("kiss_icp", reason="needs the extra `odometry`")


def away_m(found, truth):
    return np.linalg.norm(found[:, :3, 3] - truth[:, :3, 3], axis=1)


@pytest.mark.parametrize("moving", [False, True])
def test_scans_taken_while_moving_are_posed_within_centimetres(hall_drive, moving):
    drive = hall_drive(moving=moving)
    found = list(posed(drive.events()))
    T = np.stack([scan.T_first_lidar for scan in found])
    # Before the first step the speed is not known: the first turn keeps its motion, which is half of 0.3 m.
    T, truth = (inverse(poses[2]) @ poses[2:] for poses in (T, drive.truth))
    assert away_m(T, truth).max() < (0.1 if moving else 0.05)
    np.testing.assert_allclose(T[:, :3, :3], truth[:, :3, :3], atol=0.02)
    assert [scan.stamp_s for scan in found] == pytest.approx([0.1 * k for k in range(15)])


def test_motion_within_a_turn_is_taken_out_of_the_points_too(hall_drive):
    *_, scan = posed(hall_drive(moving=True).events())
    points_first = scan.points[:, :3] @ scan.T_first_lidar[:3, :3].T + scan.T_first_lidar[:3, 3]
    x = points_first[:, 0] - 6.0  # the first scan stood there
    wall = x[(np.abs(x - 16.0) < 0.6) & (np.abs(points_first[:, 1]) < 5)]
    assert len(wall) > 400
    assert np.std(wall) < 0.06  # 0.3 m of motion in the turn are 0.1 m and more


def test_a_recording_without_poses_is_followed_from_its_first_scan(hall_drive):
    told = []
    found = find_trajectory(hall_drive(), close_loops=False, report=lambda *each: told.append(each))
    np.testing.assert_allclose(found.trajectory.T_map_vehicle[0], np.eye(4), atol=1e-9)
    assert away_m(found.trajectory.T_map_vehicle, hall_drive().truth).max() < 0.05
    assert (found.loops, found.disagreement_m) == (0, (0.0, 0.0))
    assert told[-1] == ("odometry", 15, 15)


def test_poses_are_of_the_vehicle_where_the_lidars_place_is_known(hall_drive):
    drive = hall_drive()
    T_vehicle_lidar = transform_from(rotation_z(0.5), np.array([1.0, 0.0, 1.8]))
    drive.lidar = drive.lidar.model_copy(update={"T_vehicle_sensor": T_vehicle_lidar.tolist()})
    found = find_trajectory(drive, close_loops=False)
    assert away_m(found.trajectory.T_map_vehicle @ T_vehicle_lidar, drive.truth).max() < 0.05


def test_loops_are_looked_for_and_none_is_made_up_on_a_short_way(hall_drive):
    stages = set()
    found = find_trajectory(hall_drive(), report=lambda stage, *_: stages.add(stage))
    assert (found.loops, found.before is found.trajectory) == (0, True)
    assert stages == {"odometry", "loops"}


def test_nothing_to_follow_is_an_error(hall_drive):
    with pytest.raises(DatasetError, match="no scan is usable, so odometry is not possible"):
        find_trajectory(hall_drive(count_of_scans=0), close_loops=False)


def test_without_an_encoder_a_drive_is_its_poses_alone(hall_drive, tmp_path):
    drive = drive_of(posed(hall_drive(count_of_scans=3).events()), None, tmp_path)
    assert (len(drive.stamps_s), drive.keyframes, list(tmp_path.iterdir())) == (3, (), [])
    assert find_loops(drive) == []


@pytest.mark.parametrize("turn", [0, 1, 5, 23])
def test_a_place_that_was_turned_is_known_with_its_turn(turn):
    rng = np.random.default_rng(3)
    views = rng.normal(size=(24, 32)).astype(np.float32)
    views /= np.linalg.norm(views, axis=1, keepdims=True)
    others = np.stack([rng.normal(size=(24, 32)).astype(np.float32) / 6, np.roll(views, turn, axis=0)])
    similarity, turns = all_round(views, others)
    assert similarity[1] == pytest.approx(1.0, abs=1e-5)
    assert turns[1] == turn
    assert similarity[0] < 0.5


#: Of a keyframe whose scan is never read.
NO_LEVEL: Any = None


def keyframe(index, T, descriptors=None):
    return Keyframe(index, 0.1 * index, T, float(index), NO_LEVEL, 0.0, descriptors)


def square(*, turn_rad_m=0.0, stretch=1.0):
    """Return a square path of 25 m sides: a keyframe per metre with two scans each. ``turn_rad_m`` and ``stretch`` are the drift."""
    T, poses = np.eye(4), []
    for k in range(101):
        poses.append(T)
        corner = np.pi / 2 if k % 25 == 24 else 0.0
        T = T @ transform_from(rotation_z(corner + turn_rad_m), np.array([stretch, 0.0, 0.0]))
    return np.stack(poses)


def drive_on(poses, folder):
    between = poses @ transform_from(np.eye(3), np.array([0.5, 0.0, 0.0]))
    all_poses = np.stack([poses, between], axis=1).reshape(-1, 4, 4)
    stamps = np.stack([0.1 * np.arange(101), 0.1 * np.arange(101) + 0.05], axis=1).reshape(-1)
    return OdometryTrajectory(stamps, all_poses, tuple(keyframe(k, T) for k, T in enumerate(poses)), folder)


@pytest.fixture
def drifted(tmp_path):
    return drive_on(square(turn_rad_m=0.00015, stretch=1.0005), tmp_path)


TRUTH = square()


def loop(earlier, later, T=None):
    return Loop(earlier, later, inverse(TRUTH[earlier]) @ TRUTH[later] if T is None else T, 0.9, 0.9)


def test_one_exact_loop_takes_most_of_the_drift_out(drifted):
    exact = loop(0, 100)
    before = away_m(drifted.T_first_lidar[::2], TRUTH)
    T = closed(drifted, [exact])
    after = away_m(T[::2], TRUTH)
    assert before[100] > 0.2
    assert after[100] < 0.4 * before[100]
    assert after.max() < 0.7 * before.max()
    assert disagreement_m(T[::2], [exact]) < 0.4 * disagreement_m(drifted.T_first_lidar[::2], [exact])


def test_a_false_loop_beside_is_shrugged_off(drifted):
    false = loop(10, 60, transform_from(np.eye(3), np.array([1.0, 0.0, 0.0])))
    exact = [loop(0, 100), loop(1, 99)]
    right, wrong = (away_m(closed(drifted, loops)[::2], TRUTH) for loops in (exact, [*exact, false]))
    assert np.abs(wrong - right).max() < 0.2


def test_without_loops_odometry_stays_and_scans_between_keyframes_follow_theirs(drifted):
    np.testing.assert_allclose(closed(drifted, []), drifted.T_first_lidar, atol=1e-6)
    T = closed(drifted, [loop(0, 100)])
    step = inverse(T[0::2][50]) @ T[1::2][50]
    np.testing.assert_allclose(step, transform_from(np.eye(3), np.array([0.5, 0.0, 0.0])), atol=1e-9)


def test_disagreement_is_the_mean_distance_from_the_loop_constraints():
    poses = np.stack([np.eye(4), transform_from(np.eye(3), np.array([3.0, 4.0, 0.0]))])
    here = Loop(0, 1, np.eye(4), 0.9, 0.9)
    there = Loop(0, 1, poses[1], 0.9, 0.9)
    assert disagreement_m(poses, [here]) == 5.0
    assert disagreement_m(poses, [here, there]) == 2.5
    assert disagreement_m(poses, []) == 0.0


def test_a_perceptual_alias_is_not_registered(tmp_path):
    """Two places have equal views, but by odometry they are too far apart for drift. So no loop is searched."""
    views = np.ones((24, 8), np.float32) / np.sqrt(8).astype(np.float32)
    near, far = (transform_from(np.eye(3), np.array([x, 0.0, 0.0])) for x in (0.0, 100.0))
    keyframes = (keyframe(0, near, views), Keyframe(4, 1.0, far, 100.0, NO_LEVEL, 0.0, views))
    drive = OdometryTrajectory(np.array([0.0, 1.0]), np.stack([near, far]), keyframes, tmp_path)
    told = []
    assert find_loops(drive, LoopSettings(every=1), report=lambda *each: told.append(each)) == []
    assert told == [(1, 2), (2, 2)]
