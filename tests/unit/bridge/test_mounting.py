"""The mounting from TF: pose of the vehicle and height of the camera."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from service.bridge.frames import StaticFrames
from service.bridge.mounting import Mounting, MountingRule
from service.bridge.notices import Notices
from service.bridge.pose import CAMERA_AS_BODY
from service.geometry.rigid import R_BODY_OPTICAL, transform_from
from service.imaging.level import GivenHeight

Make = Callable[..., Any]
NONE = (0.0, 0.0, 0.0, 1.0)
#: The optical frame in a body frame that looks the same way.
OPTICAL = (-0.5, 0.5, -0.5, 0.5)
BOTH = MountingRule(base_frame="base_link", ground_frame="base_footprint")


def frames_of(fixed_of: Make, *, height_m: float = 0.4, turned: tuple[float, ...] = OPTICAL) -> StaticFrames:
    """Return the frames of a robot: base_link 0.1 m above base_footprint, the camera 0.2 m ahead of and above base_link."""
    frames = StaticFrames()
    frames.add(fixed_of(("base_footprint", "base_link", (0.0, 0.0, 0.1, *NONE))))
    frames.add(fixed_of(("base_link", "optical", (0.2, 0.0, height_m, *turned))))
    return frames


def found(rule: MountingRule, frames: StaticFrames) -> tuple[Mounting, tuple[str, ...]]:
    notices = Notices()
    return rule.mounting(frames, "optical", notices), notices.take()


def test_pose_and_height_come_from_their_frames(fixed_of: Make) -> None:
    """The camera is 0.4 m above base_link, so 0.5 m above the ground."""
    mounting, warnings = found(BOTH, frames_of(fixed_of))
    np.testing.assert_allclose(mounting.T_vehicle_camera, transform_from(R_BODY_OPTICAL, np.array([0.2, 0.0, 0.4])))
    assert (mounting.vehicle, warnings) == ("base_link", ())
    assert mounting.camera_height is not None
    assert (mounting.camera_height.height_m, mounting.camera_height.std_m) == (pytest.approx(0.5), 0.1)
    assert mounting.T_upright_camera is not None
    np.testing.assert_allclose(mounting.T_upright_camera[:3, 3], [0.2, 0.0, 0.5])


def test_a_vehicle_frame_on_the_ground_gives_both(fixed_of: Make) -> None:
    rule = MountingRule(base_frame="base_footprint", ground_frame="base_footprint", height_std_m=0.02)
    mounting, _ = found(rule, frames_of(fixed_of))
    assert (mounting.vehicle, mounting.T_vehicle_camera[2, 3]) == ("base_footprint", pytest.approx(0.5))
    assert mounting.camera_height is not None
    assert mounting.camera_height.std_m == 0.02


def test_what_is_given_goes_before_tf(fixed_of: Make) -> None:
    mount = transform_from(R_BODY_OPTICAL, np.array([1.0, 0.0, 1.0]))
    rule = MountingRule(
        mount=mount, base_frame="base_link", ground_frame="base_footprint", camera_height=GivenHeight(0.3, 0.05)
    )
    mounting, warnings = found(rule, frames_of(fixed_of))
    assert (mounting.vehicle, mounting.camera_height, warnings) == ("mount", GivenHeight(0.3, 0.05), ())
    np.testing.assert_array_equal(mounting.T_vehicle_camera, mount)


def test_a_frame_that_is_switched_off_gives_nothing(fixed_of: Make) -> None:
    mounting, warnings = found(MountingRule(), frames_of(fixed_of))
    assert (mounting.vehicle, mounting.camera_height, mounting.T_upright_camera) == ("camera", None, None)
    np.testing.assert_array_equal(mounting.T_vehicle_camera, CAMERA_AS_BODY)
    assert warnings == ()


def test_a_robot_without_a_frame_on_the_ground_has_no_height(fixed_of: Make) -> None:
    mounting, warnings = found(MountingRule(base_frame="base_link", ground_frame="foot"), frames_of(fixed_of))
    assert (mounting.vehicle, mounting.camera_height, warnings) == ("base_link", None, ())


def test_a_vehicle_frame_that_tf_does_not_have_is_reported_once() -> None:
    frames, notices = StaticFrames(), Notices()
    for _ in range(2):
        assert BOTH.mounting(frames, "optical", notices).vehicle == "camera"
    (told,) = notices.take()
    assert told.startswith(
        "--base-frame: /tf_static does not connect 'optical', the frame of the colour image, with 'base_link'"
    )
    assert told.endswith("publish the transform, name another --base-frame, or give --mount")
    assert not BOTH.is_complete(frames, "optical")


def test_a_frame_whose_z_axis_points_up_is_no_optical_frame(fixed_of: Make) -> None:
    mounting, (told,) = found(BOTH, frames_of(fixed_of, turned=NONE))
    assert (mounting.vehicle, mounting.T_upright_camera) == ("camera", None)
    assert "the z axis of 'optical', the frame of the colour image, points up in 'base_link'" in told
    # The height needs no orientation.
    assert mounting.camera_height is not None
    assert mounting.camera_height.height_m == pytest.approx(0.5)


@pytest.mark.parametrize(("height_m", "above"), [(-0.1, "0 m"), (40.0, "40.1 m")])
def test_a_height_out_of_bounds_is_reported(fixed_of: Make, height_m: float, above: str) -> None:
    mounting, (told,) = found(BOTH, frames_of(fixed_of, height_m=height_m))
    assert mounting.camera_height is None
    assert told.startswith(f"--ground-frame: the camera is {above} above 'base_footprint' in TF, outside 0.05 to 30 m")
    assert told.endswith("correct TF, name another --ground-frame, or give --camera-height-m")


@pytest.mark.parametrize(
    ("rule", "complete"),
    [
        (MountingRule(), True),
        (MountingRule(mount=CAMERA_AS_BODY, base_frame="nowhere"), True),
        (MountingRule(base_frame="base_link"), True),
        (MountingRule(base_frame="nowhere"), False),
    ],
)
def test_the_mounting_is_complete_with_the_vehicle_frame(fixed_of: Make, rule: MountingRule, complete: bool) -> None:
    assert rule.is_complete(frames_of(fixed_of), "optical") == complete
