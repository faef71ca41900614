from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.bridge.pose import CAMERA_AS_BODY, about, mount_from, pose_of
from service.contract.schema import LocalizeAnswer
from service.errors import RequestError
from service.geometry.rigid import R_BODY_OPTICAL, rotation_x, rotation_y, rotation_z, transform_from

Answer = Callable[..., LocalizeAnswer]


def test_a_camera_that_looks_along_x_is_a_body_without_a_turn(answer_of: Answer) -> None:
    pose = pose_of(answer_of(), CAMERA_AS_BODY, stamp_ns=7, frame_id="map")
    np.testing.assert_allclose(pose.quaternion_xyzw, [0, 0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(pose.T_map_vehicle[:3, 3], [10, 20, 1.5])
    assert (pose.stamp_ns, pose.frame_id) == (7, "map")


def test_the_covariance_stays_where_the_vehicle_is_the_camera(answer_of: Answer) -> None:
    pose = pose_of(answer_of(), CAMERA_AS_BODY, stamp_ns=0, frame_id="map")
    np.testing.assert_allclose(pose.covariance, np.diag([0.01, 0.02, 0.03, 0.001, 0.002, 0.003]), atol=1e-15)


def test_the_vehicles_origin_lies_behind_and_below_its_camera(answer_of: Answer) -> None:
    mount = transform_from(R_BODY_OPTICAL, np.array([2.0, 0.0, 1.2]))
    pose = pose_of(answer_of(), mount, stamp_ns=0, frame_id="map")
    np.testing.assert_allclose(pose.T_map_vehicle[:3, 3], [8.0, 20.0, 0.3], atol=1e-12)


def test_an_uncertain_heading_adds_lateral_uncertainty_behind_the_camera(answer_of: Answer) -> None:
    """Lever arm 2 m, heading variance 0.003 rad^2: 4 x 0.003 m^2 across, and heading and y are negatively correlated."""
    mount = transform_from(R_BODY_OPTICAL, np.array([2.0, 0.0, 0.0]))
    C = pose_of(answer_of(), mount, stamp_ns=0, frame_id="map").covariance
    np.testing.assert_allclose(C[1, 1], 0.02 + 4 * 0.003)
    np.testing.assert_allclose(C[1, 5], -2 * 0.003)
    np.testing.assert_allclose(C[2, 2], 0.03 + 4 * 0.002)
    np.testing.assert_allclose(C[0, 0], 0.01)


def test_an_answer_without_covariance_gets_a_wide_one(answer_of: Answer) -> None:
    whole = answer_of().pose
    assert whole is not None
    pose = whole.model_copy(update={"covariance": None})
    C = pose_of(answer_of(pose=pose), CAMERA_AS_BODY, stamp_ns=0, frame_id="map").covariance
    assert C[0, 0] >= 1.0
    assert np.linalg.eigvalsh(C).min() > 0


def test_moved_covariance_is_that_of_moved_samples() -> None:
    rng = np.random.default_rng(0)
    A = rng.normal(size=(6, 6))
    C = 1e-6 * (A @ A.T)
    lever = np.array([1.0, -2.0, 0.5])
    errors = rng.multivariate_normal(np.zeros(6), C, size=200_000)
    moved = errors.copy()
    for k, (dp, w) in enumerate(zip(errors[:, :3], errors[:, 3:], strict=True)):
        if k >= 2000:
            break
        R = rotation_z(w[2]) @ rotation_y(w[1]) @ rotation_x(w[0])
        moved[k, :3] = dp + R @ lever - lever
    np.testing.assert_allclose(moved[:2000, :3], errors[:2000, :3] + np.cross(errors[:2000, 3:], lever), atol=1e-4)
    moved[:, :3] = errors[:, :3] + np.cross(errors[:, 3:], lever)
    np.testing.assert_allclose(about(C, lever), np.cov(moved.T), atol=0.03 * np.abs(about(C, lever)).max())


@given(st.tuples(*[st.floats(-10, 10)] * 3))
def test_moving_there_and_back_changes_nothing(lever: tuple[float, float, float]) -> None:
    C = np.diag([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
    there = np.array(lever)
    np.testing.assert_allclose(about(about(C, there), -there), C, atol=1e-9)
    assert np.linalg.eigvalsh(about(C, there)).min() > 0


def test_a_mount_is_what_tf2_prints() -> None:
    np.testing.assert_allclose(
        mount_from("0.2, 0, 0.5, -0.5, 0.5, -0.5, 0.5"),
        transform_from(R_BODY_OPTICAL, np.array([0.2, 0.0, 0.5])),
        atol=1e-12,
    )


@pytest.mark.parametrize("text", ["", "1,2,3", "1,2,3,0,0,0,0", "1,2,3,0,0,0,2", "a,0,0,0,0,0,1", "nan,0,0,0,0,0,1"])
def test_an_invalid_mount_is_refused_with_an_example(text: Any) -> None:
    with pytest.raises(RequestError, match=r"--mount: .*such as 0\.2,0,0\.5"):
        mount_from(text)
