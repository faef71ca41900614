"""The facts of a query: motion since the last answer, prior, gravity, and what the diagnostics say about them."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from service.bridge.gravity import Imu
from service.bridge.initial_pose import InitialPoses
from service.bridge.mounting import TF_WAIT_S, MountingRule
from service.bridge.notices import Notices
from service.bridge.odometry import Odometry
from service.bridge.pose import StampedPose
from service.bridge.robot import Facts, Robot
from service.geometry.rigid import R_BODY_OPTICAL, Transform, rotation_y, transform_from
from service.localization.belief import OdometryStd

S, MS = 10**9, 10**6
Make = Callable[..., Any]
OPTICAL = (-0.5, 0.5, -0.5, 0.5)
MOUNT = transform_from(R_BODY_OPTICAL, np.array([0.5, 0.0, 0.4]))


def robot_of(**changed: Any) -> Robot:
    notices = Notices()
    given: dict[str, Any] = {
        "rule": MountingRule(mount=MOUNT),
        "odometry": Odometry("/odom", notices),
        "initial_poses": InitialPoses("/initialpose", "map", 30.0, notices),
        "notices": notices,
    }
    return Robot(**(given | changed))


def hear(robot: Robot, topic: str, message: Any, now_s: float = 100.0) -> None:
    robot.handlers(lambda: now_s)[topic](message)


def motion_of(facts: Facts) -> Transform | None:
    assert facts.known.motion is not None
    return facts.known.motion.T_previous_camera


def answered(robot: Robot, stamp_ns: int) -> Facts:
    facts = robot.facts(stamp_ns, "optical", 100.0)
    robot.answered(facts)
    return facts


def test_the_motion_is_that_of_the_camera_since_the_last_answer(odometry_of: Make) -> None:
    """The vehicle drives 2 m ahead: the camera moves 2 m along its axis. Then the vehicle turns left on the spot, with the camera 0.5 m
    ahead of its origin: the camera moves 0.5 m to the left and 0.5 m back, and turns left, which is about its -y axis."""
    robot = robot_of()
    for second, (x, yaw_deg) in enumerate([(0.0, 0.0), (2.0, 0.0), (2.0, 90.0)], start=1):
        hear(robot, "odom", odometry_of(second * S, x, 0.0, yaw_deg))
    assert motion_of(answered(robot, 1 * S)) is None
    ahead = motion_of(answered(robot, 2 * S))
    assert ahead is not None
    np.testing.assert_allclose(ahead, transform_from(np.eye(3), np.array([0.0, 0.0, 2.0])), atol=1e-12)
    turned = motion_of(answered(robot, 3 * S))
    assert turned is not None
    np.testing.assert_allclose(turned, transform_from(rotation_y(-np.pi / 2), np.array([-0.5, 0.0, -0.5])), atol=1e-12)


@pytest.mark.parametrize(("noise", "std"), [(None, None), (0.1, OdometryStd(0.02 + 0.2, float(np.deg2rad(0.2))))])
def test_the_noise_of_the_odometry_goes_with_the_motion(
    odometry_of: Make, noise: float | None, std: OdometryStd | None
) -> None:
    """A tenth of 2 m, and the 0.02 m and 0.2 degrees of any motion."""
    robot = robot_of(odometry_noise=noise)
    for second, x in enumerate([0.0, 2.0], start=1):
        hear(robot, "odom", odometry_of(second * S, x, 0.0))
    answered(robot, 1 * S)
    motion = answered(robot, 2 * S).known.motion
    assert motion is not None
    assert (motion.std is None) == (std is None)
    if motion.std is not None and std is not None:
        assert (motion.std.position_m, motion.std.angle_rad) == (
            pytest.approx(std.position_m),
            pytest.approx(std.angle_rad),
        )


def test_a_query_without_an_answer_does_not_move_the_track(odometry_of: Make) -> None:
    robot = robot_of()
    for second in (1, 2, 3):
        hear(robot, "odom", odometry_of(second * S, float(second), 0.0))
    answered(robot, 1 * S)
    robot.facts(2 * S, "optical", 100.0)  # the service did not answer
    T = motion_of(answered(robot, 3 * S))
    assert T is not None
    assert T[2, 3] == pytest.approx(2.0)


def test_without_odometry_a_query_stands_alone_and_the_track_ends(odometry_of: Make) -> None:
    robot = robot_of()
    hear(robot, "odom", odometry_of(1 * S, 0.0, 0.0))
    hear(robot, "odom", odometry_of(3 * S, 0.0, 0.0))
    answered(robot, 1 * S)
    assert answered(robot, 2 * S).known.motion is None  # a gap of 2 s
    assert motion_of(answered(robot, 3 * S)) is None
    assert robot_of(odometry=None).facts(1 * S, "optical", 100.0).known.motion is None


@pytest.mark.parametrize(("x", "continues"), [(1000.0, True), (1000.1, False)])
def test_a_jump_of_the_odometry_begins_again(odometry_of: Make, x: float, continues: bool) -> None:
    robot = robot_of()
    hear(robot, "odom", odometry_of(1 * S, 0.0, 0.0))
    hear(robot, "odom", odometry_of(2 * S, x, 0.0))
    answered(robot, 1 * S)
    assert (motion_of(answered(robot, 2 * S)) is not None) == continues


def test_an_odometry_that_began_again_begins_a_track(odometry_of: Make) -> None:
    robot = robot_of()
    hear(robot, "odom", odometry_of(9 * S, 0.0, 0.0))
    answered(robot, 9 * S)
    hear(robot, "odom", odometry_of(1 * S, 0.0, 0.0))
    assert motion_of(answered(robot, 1 * S)) is None


def test_the_mounting_on_the_body_of_the_odometry_comes_from_tf(odometry_of: Make, fixed_of: Make) -> None:
    """The odometry is that of the rear axle, 1 m behind base_link. The robot turns left: the camera moves 1.5 m to the left and back."""
    robot = robot_of(rule=MountingRule(base_frame="base_link"))
    still = (0.0, 0.0, 0.0, 1.0)
    hear(robot, "tf_static", fixed_of(("axle", "base_link", (1.0, 0.0, 0.0, *still))))
    hear(robot, "tf_static", fixed_of(("base_link", "optical", (0.5, 0.0, 0.4, *OPTICAL))))
    for second, yaw_deg in ((1, 0.0), (2, 90.0)):
        hear(robot, "odom", odometry_of(second * S, 0.0, 0.0, yaw_deg, child="axle"))
    answered(robot, 1 * S)
    T = motion_of(answered(robot, 2 * S))
    assert T is not None
    np.testing.assert_allclose(T[:3, 3], [-1.5, 0.0, -1.5], atol=1e-12)


def test_an_odometry_without_a_name_is_that_of_the_vehicle(odometry_of: Make, fixed_of: Make) -> None:
    robot = robot_of(rule=MountingRule(base_frame="base_link"))
    hear(robot, "tf_static", fixed_of(("base_link", "optical", (0.5, 0.0, 0.4, *OPTICAL))))
    hear(robot, "odom", odometry_of(1 * S, 0.0, 0.0, child=""))
    assert answered(robot, 1 * S).known.motion is not None


def test_an_odometry_whose_body_has_no_camera_is_reported(odometry_of: Make) -> None:
    robot = robot_of(rule=MountingRule())
    hear(robot, "odom", odometry_of(1 * S, 0.0, 0.0))
    assert answered(robot, 1 * S).known.motion is None
    (told,) = robot.notices.take()
    assert told.startswith(
        "--odom-topic: /tf_static does not connect 'optical', the frame of the colour image, with 'base_link'"
    )
    assert told.endswith("so the bridge does not use the odometry; publish the transform, or give --mount")


def test_a_pose_is_the_prior_until_a_pose_is_published(initial_pose_of: Make) -> None:
    robot = robot_of()
    assert robot.facts(1 * S, "optical", 100.0).known.prior is None
    hear(robot, "prior", initial_pose_of(10.0, 20.0, variances=(9.0, 9.0, 0.1)), now_s=98.0)
    for _ in range(2):
        facts = answered(robot, 1 * S)
        assert facts.known.prior is not None
        assert facts.known.prior.position_m is not None
        np.testing.assert_allclose(facts.known.prior.position_m, [10.5, 20.0])
        # 9 m2, 2 s at 1 m/s, and a lever of 0.5 m with 0.1 rad2.
        assert dict(facts.values)["prior"] == "2.0 s old, 3.6 m"
    robot.published(StampedPose(1 * S, "map", np.eye(4), np.eye(6)))
    assert robot.facts(1 * S, "optical", 100.0).known.prior is None


def test_a_prior_begins_a_track_because_only_its_first_query_reads_one(
    odometry_of: Make, initial_pose_of: Make
) -> None:
    robot = robot_of()
    for second in (1, 2, 3, 4):
        hear(robot, "odom", odometry_of(second * S, float(second), 0.0))
    assert motion_of(answered(robot, 1 * S)) is None
    assert motion_of(answered(robot, 2 * S)) is not None
    hear(robot, "prior", initial_pose_of(10.0, 20.0))
    robot.facts(3 * S, "optical", 100.0)  # the service did not answer
    begins = answered(robot, 3 * S)
    assert (motion_of(begins), dict(begins.values)["track"]) == (None, "begins")
    assert begins.known.prior is not None
    continues = answered(robot, 4 * S)
    assert dict(continues.values)["track"] == "continues"
    # The robot drove 1 m on.
    assert continues.known.prior is not None
    assert continues.known.prior.position_m is not None
    np.testing.assert_allclose(continues.known.prior.position_m, [10.5, 20.0], atol=1e-12)


@pytest.mark.parametrize(
    ("gravity", "sent", "says"),
    [("mounting", [0.0, np.sqrt(0.75), 0.5], "mounting"), ("none", None, "none"), ("imu", None, "none")],
)
def test_gravity_comes_from_its_source(gravity: str, sent: list[float] | None, says: str) -> None:
    tilted = transform_from(rotation_y(np.pi / 6) @ R_BODY_OPTICAL, np.zeros(3))
    robot = robot_of(rule=MountingRule(mount=tilted), gravity=gravity, imu=Imu("/imu", Notices()))
    facts = robot.facts(1 * S, "optical", 100.0)
    assert dict(facts.values)["gravity"] == says
    if sent is None:
        assert facts.known.down_camera is None
    else:
        assert facts.known.down_camera is not None
        np.testing.assert_allclose(facts.known.down_camera, sent, atol=1e-12)


def test_only_what_there_is_has_a_handler() -> None:
    assert set(Robot().handlers(lambda: 0.0)) == {"right_info", "tf_static"}
    assert set(robot_of(imu=Imu("/imu", Notices())).handlers(lambda: 0.0)) == {
        "right_info",
        "tf_static",
        "odom",
        "imu",
        "prior",
    }


def test_tf_is_waited_for_five_seconds_and_no_longer_than_needed(fixed_of: Make) -> None:
    robot = robot_of(rule=MountingRule(base_frame="base_link"))
    assert robot.waits_for_tf("optical", 50.0)
    assert robot.waits_for_tf("optical", 50.0 + TF_WAIT_S - 0.1)
    assert not robot.waits_for_tf("optical", 50.0 + TF_WAIT_S)
    other = robot_of(rule=MountingRule(base_frame="base_link"))
    assert other.waits_for_tf("optical", 50.0)
    hear(other, "tf_static", fixed_of(("base_link", "optical", (0.0, 0.0, 0.0, *OPTICAL))))
    assert not other.waits_for_tf("optical", 50.0)
