"""A pose in the map becomes a prior: where the camera is by it, and how sure it is."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from service.bridge.initial_pose import InitialPoses
from service.bridge.notices import Notices
from service.bridge.odometry import OdometryPose
from service.bridge.pose import StampedPose
from service.errors import RequestError
from service.geometry.rigid import R_BODY_OPTICAL, Transform, rotation_z, transform_from
from service.retrieval.prior import Prior

S = 10**9
Make = Callable[..., Any]
#: The camera looks ahead, 2 m ahead of the vehicle's origin.
MOUNT = transform_from(R_BODY_OPTICAL, np.array([2.0, 0.0, 1.0]))
UNSURE = (4.0, 4.0, 0.25)


@pytest.fixture
def notices() -> Notices:
    return Notices()


@pytest.fixture
def poses(notices: Notices) -> InitialPoses:
    return InitialPoses("/initialpose", "map", 30.0, notices)


def odom(x: float, y: float, yaw_deg: float = 0.0, session: int = 0) -> OdometryPose:
    return OdometryPose(transform_from(rotation_z(np.deg2rad(yaw_deg)), np.array([x, y, 0.0])), session)


def prior_of(
    poses: InitialPoses, now_s: float, body: OdometryPose | None = None, T_body_camera: Transform | None = None
) -> Prior:
    found = poses.prior(MOUNT, body, T_body_camera, now_s)
    assert found is not None
    return found[0]


def test_the_prior_is_that_of_the_camera(poses: InitialPoses, initial_pose_of: Make) -> None:
    """The vehicle at (10, 20) heads along y, so its camera is at (10, 22). The lever of 2 m turns a heading variance of 0.25 rad2 into
    1 m2 across: x has a variance of 5 m2."""
    poses.add(initial_pose_of(10.0, 20.0, 90.0, variances=UNSURE), 100.0, None)
    prior = prior_of(poses, 100.0)
    assert prior.position_m is not None
    np.testing.assert_allclose(prior.position_m, [10.0, 22.0], atol=1e-12)
    assert prior.position_std_m == pytest.approx(math.sqrt(5.0))
    assert prior.heading_rad == pytest.approx(math.pi / 2)
    assert prior.heading_std_rad == pytest.approx(0.5)


def test_without_odometry_a_prior_grows_with_its_age(poses: InitialPoses, initial_pose_of: Make) -> None:
    """After 3 s: 1 m/s and 20 degrees per second."""
    poses.add(initial_pose_of(10.0, 20.0, 90.0, variances=UNSURE), 100.0, None)
    prior = prior_of(poses, 103.0)
    assert prior.position_std_m == pytest.approx(math.sqrt(5.0 + 9.0))
    assert prior.heading_std_rad == pytest.approx(math.hypot(0.5, math.radians(60.0)))
    assert prior_of(poses, 130.0).heading_std_rad == pytest.approx(math.pi)


def test_with_odometry_a_prior_moves_with_the_robot(poses: InitialPoses, initial_pose_of: Make) -> None:
    """The robot drives 3 m ahead and turns left. In the map it goes from (10, 20) along y to (10, 23), and its camera looks along -x."""
    poses.add(initial_pose_of(10.0, 20.0, 90.0, variances=UNSURE), 100.0, odom(1.0, 1.0))
    prior = prior_of(poses, 103.0, odom(4.0, 1.0, 90.0), MOUNT)
    assert prior.position_m is not None
    np.testing.assert_allclose(prior.position_m, [8.0, 23.0], atol=1e-12)
    assert prior.heading_rad is not None
    assert abs(prior.heading_rad) == pytest.approx(math.pi)
    assert prior.position_std_m == pytest.approx(math.sqrt(5.0))


@pytest.mark.parametrize(("body", "T_body_camera"), [(odom(4.0, 1.0, session=1), MOUNT), (odom(4.0, 1.0), None)])
def test_an_odometry_that_began_again_or_has_no_mounting_moves_nothing(
    poses: InitialPoses, initial_pose_of: Make, body: OdometryPose, T_body_camera: Transform | None
) -> None:
    poses.add(initial_pose_of(10.0, 20.0, 90.0, variances=UNSURE), 100.0, odom(1.0, 1.0))
    prior = prior_of(poses, 101.0, body, T_body_camera)
    assert prior.position_m is not None
    np.testing.assert_allclose(prior.position_m, [10.0, 22.0], atol=1e-12)
    assert prior.position_std_m == pytest.approx(math.sqrt(6.0))


@pytest.mark.parametrize(
    ("variances", "std_m", "std_deg"),
    [
        ((0.25, 0.25, 0.0025), 1.0, 5.0),  # RViz sends 0.25 m2; nobody clicks so well
        ((0.0, 0.0, 0.0), 20.0, 20.0),  # unset: as the service assumes
        ((9.0, 1.0, 0.0), 3.0, 20.0),
        ((float("nan"), 1.0, 1.0), 20.0, 20.0),
        ((1e20, 1e20, 1e20), 1e6, 180.0),
    ],
)
def test_standard_deviations_are_bounded(
    poses: InitialPoses, initial_pose_of: Make, variances: tuple[float, float, float], std_m: float, std_deg: float
) -> None:
    poses.add(initial_pose_of(0.0, 0.0, variances=variances), 100.0, None)
    prior = prior_of(poses, 100.0)
    assert prior.position_std_m == pytest.approx(std_m, rel=0.01)
    assert math.degrees(prior.heading_std_rad) == pytest.approx(std_deg)


def test_a_pose_is_dropped_when_it_is_too_old(poses: InitialPoses, initial_pose_of: Make) -> None:
    poses.add(initial_pose_of(0.0, 0.0), 100.0, None)
    assert poses.prior(MOUNT, None, None, 130.0) is not None
    assert poses.prior(MOUNT, None, None, 130.1) is None
    assert poses.prior(MOUNT, None, None, 100.0) is None


def test_the_newest_pose_counts(poses: InitialPoses, initial_pose_of: Make) -> None:
    for x in (1.0, 5.0):
        poses.add(initial_pose_of(x, 0.0), 100.0, None)
    position_m = prior_of(poses, 100.0).position_m
    assert position_m is not None
    assert position_m[0] == 7.0
    assert poses.count == 2


def test_a_published_pose_replaces_the_prior_and_does_not_come_back(poses: InitialPoses, initial_pose_of: Make) -> None:
    poses.add(initial_pose_of(0.0, 0.0), 100.0, None)
    T = transform_from(np.eye(3), np.array([8.0, 9.0, 0.0]))
    poses.published(StampedPose(5 * S + 7, "map", T, np.eye(6)))
    assert poses.prior(MOUNT, None, None, 100.0) is None
    poses.add(initial_pose_of(8.0, 9.0, stamp_ns=5 * S + 7), 100.0, None)
    assert (poses.prior(MOUNT, None, None, 100.0), poses.count) == (None, 1)
    poses.add(initial_pose_of(8.0, 9.0, stamp_ns=5 * S + 8), 100.0, None)
    assert poses.prior(MOUNT, None, None, 100.0) is not None


def test_a_pose_in_another_frame_is_reported(poses: InitialPoses, notices: Notices, initial_pose_of: Make) -> None:
    poses.add(initial_pose_of(0.0, 0.0, frame="/map"), 100.0, None)
    assert (poses.count, notices.take()) == (1, ())
    poses.add(initial_pose_of(0.0, 0.0, frame="odom"), 100.0, None)
    assert poses.count == 1
    (told,) = notices.take()
    assert told.startswith("/initialpose: a pose has the frame 'odom', not the frame of the map, 'map'")
    assert told.endswith("publish it in the frame of the map, or name that frame by --frame")


@pytest.mark.parametrize("x", [float("inf"), 2e7])
def test_a_pose_that_is_none_is_reported(
    poses: InitialPoses, notices: Notices, initial_pose_of: Make, x: float
) -> None:
    poses.add(initial_pose_of(x, 0.0), 100.0, None)
    assert poses.count == 0
    assert notices.take()[0].startswith("/initialpose: a pose is not finite or beyond 1e+07 m")


@pytest.mark.parametrize("age_s", [0.0, -1.0, float("inf"), float("nan")])
def test_an_age_that_is_none_is_refused(age_s: float) -> None:
    with pytest.raises(RequestError, match=r"^--prior-age: .* give seconds, such as 30, or switch the prior off"):
        InitialPoses("/initialpose", "map", age_s, Notices())
