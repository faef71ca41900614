import numpy as np
import pytest

from service.bridge.pose_history import PoseHistory, between
from service.geometry.rigid import Transform, rotation_z, transform_from

S, MS = 10**9, 10**6


def pose(x: float, yaw_deg: float = 0.0) -> Transform:
    return transform_from(rotation_z(np.deg2rad(yaw_deg)), np.array([x, 0.0, 0.0]))


def filled(*stamps_and_x: tuple[int, float]) -> PoseHistory:
    poses = PoseHistory()
    for stamp_ns, x in stamps_and_x:
        poses.add(stamp_ns, pose(x))
    return poses


def x_at(poses: PoseHistory, stamp_ns: int, hold_s: float = 0.0) -> float | None:
    T = poses.at(stamp_ns, hold_s=hold_s)
    return None if T is None else float(T[0, 3])


def test_a_pose_between_two_stamps_is_interpolated() -> None:
    poses = filled((1 * S, 2.0), (1 * S + 100 * MS, 4.0))
    assert x_at(poses, 1 * S) == 2.0
    assert x_at(poses, 1 * S + 25 * MS) == pytest.approx(2.5)
    assert x_at(poses, 1 * S + 100 * MS) == 4.0


def test_a_rotation_is_interpolated_the_short_way() -> None:
    """From 170 to 190 degrees the middle is 180, although the quaternions of the two have opposite signs of z."""
    middle = between(pose(0.0, 170.0), pose(0.0, 190.0), 0.5)
    np.testing.assert_allclose(middle[:3, 0], [-1.0, 0.0, 0.0], atol=1e-12)
    quarter = between(pose(0.0, 0.0), pose(0.0, 30.0), 0.25)
    assert np.rad2deg(np.arctan2(quarter[1, 0], quarter[0, 0])) == pytest.approx(7.5, abs=0.05)


def test_no_pose_is_known_outside_the_stamps_or_in_a_gap() -> None:
    poses = filled((1 * S, 1.0), (2 * S, 2.0))
    assert x_at(poses, 1 * S - 1) is None
    assert x_at(poses, 2 * S + 1) is None
    assert x_at(poses, 1 * S + 500 * MS) is None
    assert x_at(PoseHistory(), 0, hold_s=9.0) is None


def test_the_first_and_the_last_pose_hold_a_little_longer_if_wanted() -> None:
    poses = filled((1 * S, 1.0), (1 * S + 400 * MS, 2.0))
    assert x_at(poses, 1 * S - 100 * MS, 0.1) == 1.0
    assert x_at(poses, 1 * S + 500 * MS, 0.1) == 2.0
    assert x_at(poses, 1 * S + 501 * MS, 0.1) is None


def test_an_older_stamp_is_dropped_and_a_much_older_one_begins_again() -> None:
    poses = filled((5 * S, 5.0), (5 * S, 6.0), (4 * S, 4.0))
    assert (poses.session, poses.newest_ns, x_at(poses, 5 * S)) == (0, 5 * S, 5.0)
    poses.add(4 * S - 1, pose(1.0))
    assert (poses.session, poses.newest_ns, x_at(poses, 5 * S)) == (1, 4 * S - 1, None)
    newest = poses.newest()
    assert newest is not None
    assert newest[0, 3] == 1.0


def test_the_oldest_poses_are_dropped() -> None:
    poses = PoseHistory(most=3)
    for number in range(10):
        poses.add(number * 100 * MS, pose(float(number)))
    assert x_at(poses, 700 * MS) == 7.0
    assert x_at(poses, 600 * MS) is None
