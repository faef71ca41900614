"""The bridge built from its settings, and the event that signals set."""

import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from service.bridge.bridge import Topics
from service.bridge.opening import opened, until_signalled
from service.bridge.pose import CAMERA_AS_BODY
from service.bridge.settings import BridgeSettings
from service.client import Client
from service.errors import RequestError
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import R_BODY_OPTICAL, quaternion_xyzw_from, rotation_y
from service.imaging.level import GivenHeight

#: Colour, depth and camera of an image pair.
PICTURES = (
    np.zeros((4, 6, 3), np.uint8),
    np.ones((4, 6), np.float32),
    PinholeCamera(6, 4, 3.0, 3.0, 2.5, 1.5),
)


def test_every_setting_reaches_the_bridge() -> None:
    settings = BridgeSettings(
        color_topic="/c",
        depth_topic="/d",
        info_topic="/i",
        pose_topic="/p",
        diagnostics_topic="/g",
        frame="earth",
        mount="1,2,3,0,0,0,1",
        rectified=True,
        right_info_topic="/r",
        tf_static_topic="/t",
        base_frame="base",
        ground_frame="foot",
        camera_height_m=0.3,
        camera_height_std_m=0.02,
        gravity="imu",
        imu_topic="/m",
        odom_topic="/o",
        odometry_noise=0.1,
        prior_topic="/n",
        prior_age=7.0,
        rate=0.5,
        min_confidence=0.25,
        tolerance=0.125,
    )
    with opened(settings) as bridge:
        assert bridge.topics == Topics(
            "/c", "/d", "/i", "/p", "/g", right_info="/r", tf_static="/t", odom="/o", imu="/m", prior="/n"
        )
        assert set(bridge.handlers()) == {"color", "depth", "info", "right_info", "tf_static", "odom", "imu", "prior"}
        assert (bridge.frame_id, bridge.rectified) == ("earth", True)
        assert (bridge.policy.rate_hz, bridge.policy.min_confidence) == (0.5, 0.25)
        assert bridge.pairs._tolerance_ns == 125_000_000
        rule = bridge.robot.rule
        assert rule.mount is not None
        np.testing.assert_array_equal(rule.mount[:3, 3], [1, 2, 3])
        assert (rule.base_frame, rule.ground_frame) == ("base", "foot")
        assert (rule.camera_height, rule.height_std_m) == (GivenHeight(0.3, 0.02), 0.02)
        assert (bridge.robot.gravity, bridge.robot.odometry_noise) == ("imu", 0.1)
        poses = bridge.robot.initial_poses
        assert poses is not None
        assert (poses._topic, poses._frame_id, poses._most_age_s) == ("/n", "earth", 7.0)


def test_the_default_topics_are_those_of_a_usual_robot() -> None:
    with opened(BridgeSettings()) as bridge:
        assert bridge.topics == Topics(tf_static="/tf_static", odom="/odom", prior="/initialpose")
        rule = bridge.robot.rule
        assert (rule.mount, rule.base_frame, rule.ground_frame) == (None, "base_link", "base_footprint")
        assert (rule.camera_height, rule.height_std_m, bridge.robot.gravity) == (None, 0.1, "mounting")


def test_what_the_robot_publishes_can_be_switched_off() -> None:
    settings = BridgeSettings(tf_static_topic="", odom_topic="", prior_topic="", gravity="none")
    with opened(settings) as bridge:
        assert bridge.topics == Topics()
        assert set(bridge.handlers()) == {"color", "depth", "info"}
        rule = bridge.robot.rule
        assert (rule.base_frame, rule.ground_frame) == ("", "")
        facts = bridge.robot.facts(0, "optical", 0.0)
        assert (facts.known.camera_height, facts.known.prior, facts.known.motion) == (None, None, None)
        np.testing.assert_array_equal(facts.mounting.T_vehicle_camera, CAMERA_AS_BODY)


@pytest.mark.parametrize(
    ("changed", "frames"),
    [
        ({}, ("base_link", "base_link")),
        ({"mount": "0,0,0.4,0,0,0,1"}, ("base_link", "")),
        ({"base_frame": "f"}, ("f", "f")),
    ],
)
def test_a_vehicle_frame_on_the_ground_replaces_the_ground_frame(
    changed: dict[str, object], frames: tuple[str, str]
) -> None:
    with opened(replace(BridgeSettings(base_on_ground=True), **changed)) as bridge:  # type: ignore[arg-type]
        assert (bridge.robot.rule.base_frame, bridge.robot.rule.ground_frame) == frames
        assert (bridge.robot.rule.camera_height is not None) == ("mount" in changed)


def test_a_map_answers_without_a_service(bundle_path: Path) -> None:
    with opened(BridgeSettings(map=bundle_path, url="http://nowhere.invalid")) as bridge:
        assert type(bridge.localize).__name__ == "InPlace"


@pytest.mark.parametrize(("rate", "asked"), [(0.0, None), (0.02, 0.02)])
def test_the_false_accept_rate_of_the_settings_is_asked_for(
    bundle_path: Path, rate: float, asked: float | None
) -> None:
    for settings in (BridgeSettings(false_accept_rate=rate), BridgeSettings(false_accept_rate=rate, map=bundle_path)):
        with opened(settings) as bridge:
            assert bridge.localize._false_accept_rate == asked  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"rate": -1.0}, "--rate: -1.0 is not a valid rate"),
        ({"min_confidence": 2.0}, "--min-confidence: 2.0 is not a valid probability"),
        ({"tolerance": -1.0}, "tolerance: -1.0 is not a valid time"),
        ({"mount": "1,2"}, "--mount: '1,2' is invalid; give X,Y,Z"),
        ({"queue": -1}, "--queue: -1 is not a valid number of images; give 1 or more, or 0 to keep all"),
        ({"url": "nowhere"}, "url: 'nowhere' is not a URL"),
        ({"camera_height_m": 40.0}, "--camera-height-m: 40 m is not a valid camera height; give 0.05 to 30 m"),
        ({"baseline_m": 0.0005}, "--baseline-m: 0.0005 m is not a valid baseline; give 0.001 to 100 m, or 0 if"),
        ({"baseline_m": -0.12}, "--baseline-m: -0.12 m is not a valid baseline"),
        (
            {"base_on_ground": True, "base_frame": ""},
            "--base-on-ground: .* give --mount or both of them, or --camera-height-m",
        ),
        ({"base_on_ground": True, "tf_static_topic": ""}, "--base-on-ground: there is no vehicle frame"),
        (
            {"camera_height_std_m": 3.0},
            "--camera-height-std-m: 3 m is not a valid standard deviation; give 0.005 to 2 m, or 0",
        ),
        ({"gravity": "moon"}, "--gravity: 'moon' is not a source of gravity; give mounting, imu or none"),
        ({"gravity": "imu", "imu_topic": ""}, "--gravity: imu needs the IMU and its mounting, but --imu-topic or"),
        ({"gravity": "imu", "tf_static_topic": ""}, "--gravity: imu needs the IMU and its mounting"),
        ({"odometry_noise": -0.1}, "--odometry-noise: -0.1 is no share of the distance; give 0 to 1"),
        ({"false_accept_rate": 1.0}, "--false-accept-rate: 1 is no share; give 1e-06 or more and less than 1, or 0"),
        ({"prior_age": 0.0}, "--prior-age: 0 is not a valid age; give seconds"),
        ({"base_on_ground": True, "mount": "0,0,0,0,0,0,1"}, "--mount: with --base-on-ground, its Z of 0 m"),
        ({"map": Path("m"), "map_name": "n"}, "--map gives one map"),
        ({"map": Path("m"), "cert": Path("c")}, "--cert: it is only for a service"),
    ],
)
def test_a_setting_that_makes_no_sense_is_refused(changed: dict[str, object], words: str) -> None:
    with pytest.raises(RequestError, match=words), opened(replace(BridgeSettings(), **changed)):  # type: ignore[arg-type]
        pytest.fail("opened")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_sets_the_event_once_and_the_handlers_come_back(number: signal.Signals) -> None:
    before = signal.getsignal(number)
    with until_signalled() as over:
        assert not over.is_set()
        signal.raise_signal(number)
        assert over.is_set()
        assert signal.getsignal(number) == before
    assert signal.getsignal(number) == before


@pytest.mark.parametrize(
    ("changed", "height"),
    [
        ({}, {}),
        ({"base_on_ground": True}, {"camera_height_m": 0.42, "camera_height_std_m": 0.1}),
        ({"base_on_ground": True, "camera_height_std_m": 0.2}, {"camera_height_m": 0.42, "camera_height_std_m": 0.2}),
        ({"camera_height_m": 0.3}, {"camera_height_m": 0.3, "camera_height_std_m": 0.05}),
        ({"camera_height_m": 0.3, "camera_height_std_m": 0.2}, {"camera_height_m": 0.3, "camera_height_std_m": 0.2}),
        ({"base_on_ground": True, "camera_height_m": 0.3}, {"camera_height_m": 0.3, "camera_height_std_m": 0.05}),
    ],
)
def test_the_camera_height_of_the_settings_is_sent(
    monkeypatch: pytest.MonkeyPatch, changed: dict[str, object], height: dict[str, float]
) -> None:
    asked: list[dict[str, object]] = []
    monkeypatch.setattr(Client, "localize", lambda *_, **about: asked.append(about))
    settings = replace(BridgeSettings(mount="0.1,0,0.42,-0.5,0.5,-0.5,0.5"), **changed)  # type: ignore[arg-type]
    with opened(settings) as bridge:
        bridge.localize(*PICTURES, bridge.robot.facts(0, "optical", 0.0).known)
    assert asked == [{"map": None} | height]


def test_height_and_gravity_of_tf_are_sent(monkeypatch: pytest.MonkeyPatch, fixed_of: Any) -> None:
    """The camera is 0.4 m above base_footprint and looks down by 30 degrees. The quaternion is that of rotation_y(30) R_BODY_OPTICAL."""
    asked: list[dict[str, Any]] = []
    monkeypatch.setattr(Client, "localize", lambda *_, **about: asked.append(about))
    x, y, z, w = quaternion_xyzw_from(rotation_y(np.pi / 6) @ R_BODY_OPTICAL).tolist()
    with opened(BridgeSettings(base_frame="base_footprint")) as bridge:
        bridge.handlers()["tf_static"](fixed_of(("base_footprint", "optical", (0.1, 0.0, 0.4, x, y, z, w))))
        bridge.localize(*PICTURES, bridge.robot.facts(0, "optical", 0.0).known)
    (about,) = asked
    np.testing.assert_allclose(about.pop("gravity"), [0.0, np.sqrt(0.75), 0.5], atol=1e-12)
    assert about == {"map": None, "camera_height_m": pytest.approx(0.4), "camera_height_std_m": 0.1}


@pytest.mark.parametrize(
    ("changed", "topic", "sent"),
    [
        ({}, "", {}),
        ({"baseline_m": 0.12}, "", {"baseline_m": 0.12}),
        ({"right_info_topic": "/right"}, "/right", {"baseline_m": 0.5}),
        ({"right_info_topic": "/right", "baseline_m": 0.12}, "", {"baseline_m": 0.12}),
    ],
)
def test_the_baseline_of_the_settings_or_of_the_right_camera_is_sent(
    monkeypatch: pytest.MonkeyPatch, info_of: Any, changed: dict[str, object], topic: str, sent: dict[str, float]
) -> None:
    asked: list[dict[str, object]] = []
    monkeypatch.setattr(Client, "localize", lambda *_, **about: asked.append(about))
    with opened(replace(BridgeSettings(), **changed)) as bridge:  # type: ignore[arg-type]
        assert bridge.topics.right_info == topic
        if topic:
            bridge.handlers()["right_info"](info_of(p=[400.0, 0, 0, -200.0, 0, 400.0, 0, 0, 0, 0, 1, 0]))
        bridge.localize(*PICTURES, bridge.robot.facts(0, "optical", 0.0).known)
    assert asked == [{"map": None} | sent]
