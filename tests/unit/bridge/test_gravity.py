"""Down in the camera frame (x right, y down, z forward): from the mounting and from an IMU."""

import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from service.bridge.frames import StaticFrames
from service.bridge.gravity import Imu, down_on_vehicle
from service.bridge.notices import Notices
from service.geometry.rigid import (
    R_BODY_OPTICAL,
    Rotation,
    Transform,
    quaternion_xyzw_from,
    rotation_x,
    rotation_y,
    rotation_z,
    transform_from,
)

S, MS = 10**9, 10**6
Make = Callable[..., Any]
OPTICAL = (-0.5, 0.5, -0.5, 0.5)
COS_10, SIN_10 = math.cos(math.radians(10)), math.sin(math.radians(10))


def mounted(rotation: Rotation) -> Transform:
    """Return the mounting of a camera that looks ahead and is then turned in the vehicle."""
    return transform_from(rotation @ R_BODY_OPTICAL, np.array([0.2, 0.0, 0.5]))


@pytest.mark.parametrize(
    ("turned", "down"),
    [
        (rotation_y(math.radians(30)), [0.0, math.sqrt(0.75), 0.5]),  # looks down: the ground comes ahead
        (rotation_y(math.radians(-30)), [0.0, math.sqrt(0.75), -0.5]),  # looks up
        (rotation_x(math.radians(10)), [SIN_10, COS_10, 0.0]),  # its right side is lower
        (rotation_z(math.radians(90)) @ rotation_y(math.radians(30)), [0.0, math.sqrt(0.75), 0.5]),  # looks left
        (rotation_x(math.pi), [0.0, -1.0, 0.0]),  # hangs upside down
        (rotation_y(math.radians(2.1)), [0.0, 0.999328, 0.036644]),
    ],
)
def test_a_tilted_mounting_says_where_down_is(turned: Rotation, down: list[float]) -> None:
    found = down_on_vehicle(mounted(turned), Notices())
    assert found is not None
    np.testing.assert_allclose(found, down, atol=1e-6)


@pytest.mark.parametrize("pitch_deg", [-1.9, 0.0, 1.9])
def test_a_level_mounting_says_nothing(pitch_deg: float) -> None:
    notices = Notices()
    assert down_on_vehicle(mounted(rotation_y(math.radians(pitch_deg))), notices) is None
    assert down_on_vehicle(None, notices) is None
    assert notices.take() == ()


def test_a_camera_that_looks_straight_down_is_reported() -> None:
    notices = Notices()
    assert down_on_vehicle(mounted(rotation_y(math.radians(71))), notices) is None
    (told,) = notices.take()
    assert told.startswith("--gravity mounting: by its mounting the camera looks straight up or down")
    assert told.endswith("check --mount, or that the images name an optical frame (x right, y down, z forward)")
    assert down_on_vehicle(mounted(rotation_y(math.radians(69))), notices) is not None


def imu_message(stamp_ns: int, rotation: Rotation, *, measured: bool = True) -> Any:
    x, y, z, w = quaternion_xyzw_from(rotation).tolist()
    sec, nanosec = divmod(stamp_ns, S)
    return SimpleNamespace(
        header=SimpleNamespace(stamp=SimpleNamespace(sec=sec, nanosec=nanosec), frame_id="imu_link"),
        orientation=SimpleNamespace(x=x, y=y, z=z, w=w),
        orientation_covariance=[0.0 if measured else -1.0] + [0.0] * 8,
    )


def frames_of(fixed_of: Make, *, turned: tuple[float, ...] = (0.0, 0.0, 0.0, 1.0)) -> StaticFrames:
    frames = StaticFrames()
    frames.add(fixed_of(("base", "imu_link", (0.0, 0.0, 0.2, *turned)), ("base", "optical", (0.2, 0.0, 0.4, *OPTICAL))))
    return frames


@pytest.fixture
def imu() -> Imu:
    return Imu("/imu/data", Notices())


def test_the_orientation_of_an_imu_says_where_down_is(imu: Imu, fixed_of: Make) -> None:
    """The robot drives north-west down a slope of 10 degrees. The camera is level on the robot."""
    imu.add(imu_message(5 * S, rotation_z(math.radians(135)) @ rotation_y(math.radians(10))))
    down = imu.down(5 * S + 100 * MS, "optical", frames_of(fixed_of))
    assert down is not None
    np.testing.assert_allclose(down, [0.0, COS_10, SIN_10], atol=1e-12)


def test_the_mounting_of_the_imu_counts(imu: Imu, fixed_of: Make) -> None:
    """The IMU is mounted upside down, turned about x by 180 degrees. So a level robot has an IMU with this orientation."""
    imu.add(imu_message(5 * S, rotation_x(math.pi)))
    down = imu.down(5 * S, "optical", frames_of(fixed_of, turned=(1.0, 0.0, 0.0, 0.0)))
    assert down is not None
    np.testing.assert_allclose(down, [0.0, 1.0, 0.0], atol=1e-12)


def test_an_orientation_of_another_time_says_nothing(imu: Imu, fixed_of: Make) -> None:
    imu.add(imu_message(5 * S, np.eye(3)))
    assert imu.down(5 * S + 101 * MS, "optical", frames_of(fixed_of)) is None


@pytest.mark.parametrize("measured", [True, False])
def test_an_imu_without_orientation_is_reported(fixed_of: Make, measured: bool) -> None:
    notices = Notices()
    imu, message = Imu("/imu", notices), imu_message(5 * S, np.eye(3), measured=measured)
    if measured:
        message.orientation.w = 0.0
    imu.add(message)
    assert imu.down(5 * S, "optical", frames_of(fixed_of)) is None
    (told,) = notices.take()
    assert told.startswith("/imu: the messages have no orientation, so the bridge sends no gravity; run a filter")


def test_an_imu_without_a_place_on_the_robot_is_reported(fixed_of: Make) -> None:
    notices = Notices()
    imu = Imu("/imu", notices)
    imu.add(imu_message(5 * S, np.eye(3)))
    assert imu.down(5 * S, "optical", StaticFrames()) is None
    assert notices.take()[0].startswith("/imu: TF has no fixed transform from 'imu_link' to 'optical'")


def test_an_imu_by_which_the_camera_looks_down_is_reported(fixed_of: Make) -> None:
    notices = Notices()
    imu = Imu("/imu", notices)
    imu.add(imu_message(5 * S, rotation_y(math.radians(80))))
    assert imu.down(5 * S, "optical", frames_of(fixed_of)) is None
    assert "by the IMU the camera looks straight up or down" in notices.take()[0]
