from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from service.bridge.bridge import IDLE_S, Bridge, Topics, line_of
from service.bridge.diagnostics import Level
from service.bridge.initial_pose import InitialPoses
from service.bridge.mounting import MountingRule
from service.bridge.notices import Notices
from service.bridge.odometry import Odometry
from service.bridge.pose import CAMERA_AS_BODY
from service.bridge.publish_policy import PublishPolicy
from service.bridge.rig import StereoRig
from service.bridge.robot import Robot as OfRobot
from service.contract.schema import LocalizeAnswer
from service.errors import RequestError, UnreachableError

S, MS = 10**9, 10**6
RGB, DEPTH = np.full((4, 6, 3), 7, np.uint8), np.full((4, 6), 2500, np.uint16)
Make = Callable[..., Any]
Answer = Callable[..., LocalizeAnswer]


class Robot:
    """A bridge with its clock and images. Each answer takes half a second."""

    def __init__(self, image_of: Make, info_of: Make, answer_of: Answer) -> None:
        self.now_s = 50.0
        self.asked: list[Any] = []
        self.answer: Any = answer_of()
        self._image_of, self._info_of = image_of, info_of

    def localize(self, *given: Any) -> LocalizeAnswer:
        self.asked.append(given)
        self.now_s += 0.5
        if isinstance(self.answer, Exception):
            raise self.answer
        return self.answer

    def bridge(self, **how: Any) -> Bridge:
        return Bridge(localize=self.localize, clock=lambda: self.now_s, **how)

    def see(self, bridge: Bridge, stamp_ns: int, *, encoding: str = "rgb8") -> None:
        bridge.pairs.info(self._info_of(stamp_ns))
        bridge.pairs.color(self._image_of(RGB, encoding, stamp_ns))
        bridge.pairs.depth(self._image_of(DEPTH, "16UC1", stamp_ns + 3 * MS))


@pytest.fixture
def robot(image_of: Make, info_of: Make, answer_of: Answer) -> Robot:
    return Robot(image_of, info_of, answer_of)


def test_a_sure_answer_is_a_pose_with_the_pictures_stamp(robot: Robot) -> None:
    bridge = robot.bridge(frame_id="world")
    robot.see(bridge, 5 * S)
    published = bridge.step()
    assert published is not None
    assert published.pose is not None
    assert (published.pose.stamp_ns, published.pose.frame_id) == (5 * S, "world")
    assert published.diagnosis.level == Level.OK
    ((rgb, depth_m, camera, known),) = robot.asked
    np.testing.assert_array_equal(rgb, RGB)
    np.testing.assert_allclose(depth_m, 2.5)
    assert camera.fx == 3.0
    assert (known.baseline_m, known.camera_height) == (None, None)


def test_diagnoses_carry_what_an_operator_looks_for(robot: Robot) -> None:
    bridge = robot.bridge()
    robot.see(bridge, 5 * S)
    published = bridge.step()
    assert published is not None
    assert dict(published.diagnosis.values) == {
        "status": "LOCALIZED",
        "confidence": "0.950",
        "street": "End",
        "map": "tiny@abc",
        "camera_height": "0.31 m, given",
        "threshold": "none",
        "calibration": "unknown",
        "extrapolated": "none",
        "rig_correction": "none",
        "belief": "none",
        "epoch": "none",
        "latency_ms": "500",
        "pose_of": "camera",
        "gravity": "none",
        "prior": "none",
        "track": "none",
        "queries": "1",
        "answered": "1",
        "published": "1",
        "failed": "0",
        "dropped": "0",
        "rate_hz": "0.00",
    }


def test_no_query_is_sent_without_a_pair(robot: Robot) -> None:
    assert robot.bridge().step() is None
    assert robot.asked == []


def test_the_rate_is_limited_and_the_newest_pair_is_sent(robot: Robot) -> None:
    bridge = robot.bridge(policy=PublishPolicy(rate_hz=1.0))
    robot.see(bridge, 1 * S)
    assert bridge.step() is not None
    robot.see(bridge, 2 * S)
    robot.see(bridge, 3 * S)
    assert bridge.wait_s() == pytest.approx(0.5)
    assert bridge.step() is None
    robot.now_s += 0.5
    published = bridge.step()
    assert published is not None
    assert published.diagnosis.stamp_ns == 3 * S
    assert dict(published.diagnosis.values)["dropped"] == "2"
    assert dict(published.diagnosis.values)["rate_hz"] == "1.00"


def test_without_a_limit_every_pair_has_its_turn(robot: Robot) -> None:
    bridge = robot.bridge(policy=PublishPolicy(rate_hz=0.0))
    for second in (1, 2, 3):
        robot.see(bridge, second * S)
    stamps = []
    while (published := bridge.step()) is not None:
        stamps.append(published.diagnosis.stamp_ns // S)
    assert stamps == [1, 2, 3]
    assert bridge.quiet_s() == IDLE_S


@pytest.mark.parametrize(
    ("changed", "policy", "why"),
    [
        ({"confidence": 0.9}, PublishPolicy(min_confidence=0.9), ""),
        ({"confidence": 0.899}, PublishPolicy(min_confidence=0.9), "confidence 0.899 is below 0.9"),
        ({"status": "AMBIGUOUS"}, PublishPolicy(min_confidence=0.0), "AMBIGUOUS"),
        ({"status": "OUT_OF_MAP"}, PublishPolicy(min_confidence=0.0), "OUT_OF_MAP"),
        ({"confidence": None}, PublishPolicy(min_confidence=0.1), "no confidence: the map is not calibrated"),
        ({"confidence": None}, PublishPolicy(min_confidence=0.0), ""),
    ],
)
def test_only_answers_that_pass_the_policy_are_published_and_the_rest_is_diagnosed(
    robot: Robot, answer_of: Answer, changed: dict[str, Any], policy: PublishPolicy, why: str
) -> None:
    robot.answer = answer_of(**changed)
    bridge = robot.bridge(policy=policy)
    policy._last_query_s = None
    robot.see(bridge, 1 * S)
    published = bridge.step()
    assert published is not None
    assert (published.pose is None) == bool(why)
    assert why in published.diagnosis.message
    assert published.diagnosis.level == (Level.WARN if why else Level.OK)


@pytest.mark.parametrize("error", [UnreachableError("nobody there"), RequestError("too dark")])
def test_a_failed_query_is_reported_and_the_next_is_sent(robot: Robot, answer_of: Answer, error: Exception) -> None:
    bridge = robot.bridge(policy=PublishPolicy(rate_hz=0.0))
    robot.answer = error
    robot.see(bridge, 1 * S)
    published = bridge.step()
    assert published is not None
    assert (published.pose, published.diagnosis.level, published.diagnosis.message) == (None, Level.ERROR, str(error))
    assert dict(published.diagnosis.values)["failed"] == "1"
    robot.answer = answer_of()
    robot.see(bridge, 2 * S)
    assert (bridge.step() or published).pose is not None


def test_an_invalid_image_is_reported_with_its_topic(robot: Robot) -> None:
    bridge = robot.bridge()
    robot.see(bridge, 1 * S, encoding="bayer_rggb8")
    published = bridge.step()
    assert published is not None
    assert published.diagnosis.message.startswith(
        "/camera/color/image_raw: the encoding 'bayer_rggb8' is not supported"
    )
    assert robot.asked == []


def test_silence_names_the_topics_that_bring_nothing(robot: Robot, info_of: Make, image_of: Make) -> None:
    bridge = robot.bridge()
    bridge.pairs.info(info_of(0))
    told = bridge.idle()
    assert told.level == Level.WARN
    assert "color (/camera/color/image_raw), depth (/camera/aligned_depth_to_color/image_raw); check" in told.message
    bridge.pairs.color(image_of(RGB, "rgb8", 0))
    bridge.pairs.depth(image_of(DEPTH, "16UC1", S))
    assert "--tolerance" in bridge.idle().message


def test_no_query_is_sent_before_the_right_cameras_calibration_is_there(robot: Robot, info_of: Make) -> None:
    rig = StereoRig(topic="/right")
    bridge = robot.bridge(topics=Topics(right_info="/right"), robot=OfRobot(rig=rig))
    robot.see(bridge, 1 * S)
    assert bridge.step() is None
    assert "no messages on right_info (/right); check" in bridge.idle().message
    bridge.handlers()["right_info"](info_of(p=[500.0, 0, 0, -60.0, 0, 500.0, 0, 0, 0, 0, 1, 0]))
    assert bridge.step() is not None
    ((*_, known),) = robot.asked
    assert known.baseline_m == 0.12


def test_the_first_pairs_wait_for_the_mounting_in_tf(robot: Robot, fixed_of: Make) -> None:
    """The camera is at (10, 20, 1.5) and looks along x, 0.5 m ahead of base_link and 0.4 m above it."""
    bridge = robot.bridge(
        topics=Topics(tf_static="/tf_static"), robot=OfRobot(rule=MountingRule(base_frame="base_link"))
    )
    robot.see(bridge, 1 * S)
    assert bridge.step() is None
    assert bridge.idle().message == "waiting for the mounting of the camera 'optical' on /tf_static"
    bridge.handlers()["tf_static"](fixed_of(("base_link", "optical", (0.5, 0.0, 0.4, -0.5, 0.5, -0.5, 0.5))))
    published = bridge.step()
    assert published is not None
    assert published.pose is not None
    np.testing.assert_allclose(published.pose.T_map_vehicle[:3, 3], [9.5, 20.0, 1.1])
    assert (dict(published.diagnosis.values)["pose_of"], published.warnings) == ("base_link", ())


def test_without_a_mounting_in_tf_the_pose_is_that_of_the_camera_and_the_operator_is_told(
    robot: Robot, fixed_of: Make
) -> None:
    bridge = robot.bridge(policy=PublishPolicy(rate_hz=0.0), robot=OfRobot(rule=MountingRule(base_frame="base_link")))
    robot.see(bridge, 1 * S)
    assert bridge.step() is None
    robot.now_s += 5.0
    first = bridge.step()
    robot.see(bridge, 2 * S)
    second = bridge.step()
    assert first is not None
    assert second is not None
    assert second.pose is not None
    np.testing.assert_allclose(second.pose.T_map_vehicle[:3, 3], [10.0, 20.0, 1.5])
    (told,) = first.warnings
    assert "so the published pose is that of the camera" in told
    assert second.warnings == ()
    bridge.robot.frames.add(fixed_of(("base_link", "optical", (0.5, 0.0, 0.4, -0.5, 0.5, -0.5, 0.5))))
    robot.see(bridge, 3 * S)
    late = bridge.step()
    assert late is not None
    assert late.pose is not None
    np.testing.assert_allclose(late.pose.T_map_vehicle[:3, 3], [9.5, 20.0, 1.1])


def odometry_robot(**changed: Any) -> OfRobot:
    notices = Notices()
    return OfRobot(
        rule=MountingRule(mount=CAMERA_AS_BODY), odometry=Odometry("/odom", notices), notices=notices, **changed
    )


@pytest.mark.parametrize("rate_hz", [0.0, 1.0])
def test_a_pair_waits_for_its_odometry_half_a_second(robot: Robot, odometry_of: Make, rate_hz: float) -> None:
    bridge = robot.bridge(policy=PublishPolicy(rate_hz=rate_hz), topics=Topics(odom="/odom"), robot=odometry_robot())
    bridge.handlers()["odom"](odometry_of(1 * S, 0.0, 0.0))
    robot.see(bridge, 1 * S + 10 * MS)
    assert bridge.step() is None
    bridge.handlers()["odom"](odometry_of(1 * S + 20 * MS, 0.0, 0.0))
    with_odometry = bridge.step()
    robot.now_s += 1.0
    robot.see(bridge, 2 * S)
    assert bridge.step() is None
    robot.now_s += 0.4
    assert bridge.step() is None
    robot.now_s += 0.2
    without = bridge.step()
    robot.now_s += 1.0
    robot.see(bridge, 3 * S)  # the odometry has ended, so this pair does not wait
    at_once = bridge.step()
    told = []
    for published in (with_odometry, without, at_once):
        assert published is not None
        told.append((published.diagnosis.stamp_ns, dict(published.diagnosis.values)["track"]))
    assert told == [(1 * S + 10 * MS, "begins"), (2 * S, "none"), (3 * S, "none")]


def test_with_a_rate_limit_the_newest_pair_that_has_its_odometry_is_sent(robot: Robot, odometry_of: Make) -> None:
    bridge = robot.bridge(topics=Topics(odom="/odom"), robot=odometry_robot())
    for stamp_ns in (1 * S, 1 * S + 100 * MS):
        bridge.handlers()["odom"](odometry_of(stamp_ns, 0.0, 0.0))
    for stamp_ns in (1 * S + 20 * MS, 1 * S + 60 * MS, 1 * S + 110 * MS):
        robot.see(bridge, stamp_ns)
    published = bridge.step()
    assert published is not None
    assert published.diagnosis.stamp_ns == 1 * S + 60 * MS


def test_a_pose_of_an_operator_is_the_prior_until_an_answer_is_published(
    robot: Robot, answer_of: Answer, initial_pose_of: Make
) -> None:
    """The bridge publishes on the topic that it reads. Its own pose is no prior."""
    notices = Notices()
    poses = InitialPoses("/initialpose", "map", 30.0, notices)
    bridge = robot.bridge(
        policy=PublishPolicy(rate_hz=0.0, min_confidence=0.9),
        topics=Topics(prior="/initialpose"),
        robot=OfRobot(initial_poses=poses, notices=notices),
    )
    bridge.handlers()["prior"](initial_pose_of(1.0, 2.0))
    priors = []
    for second, confidence in enumerate([0.5, 0.95, 0.95], start=1):
        robot.answer = answer_of(confidence=confidence)
        robot.see(bridge, second * S)
        published = bridge.step()
        assert published is not None
        if published.pose is not None:
            x, y, _ = published.pose.T_map_vehicle[:3, 3]
            bridge.handlers()["prior"](initial_pose_of(x, y, stamp_ns=published.pose.stamp_ns))
        *_, known = robot.asked[-1]
        priors.append(None if known.prior is None else known.prior.position_m.tolist())
    assert priors == [[1.0, 2.0], [1.0, 2.0], None]


def test_a_calibration_that_is_not_of_a_right_camera_is_reported(robot: Robot, info_of: Make) -> None:
    bridge = robot.bridge(topics=Topics(right_info="/right"), robot=OfRobot(rig=StereoRig(topic="/right")))
    robot.see(bridge, 1 * S)
    bridge.handlers()["right_info"](info_of())
    published = bridge.step()
    assert published is not None
    assert (published.diagnosis.level, robot.asked) == (Level.ERROR, [])
    assert published.diagnosis.message.startswith("/right: its P[0, 3] of 0 and fx of 0 px mean a baseline of 0 m")


def test_only_topics_with_a_name_have_a_handler(robot: Robot) -> None:
    assert list(robot.bridge().handlers()) == ["color", "depth", "info"]
    every = Topics(right_info="/r", tf_static="/t", odom="/o")
    assert list(robot.bridge(topics=every, robot=odometry_robot()).handlers())[3:] == [
        "right_info",
        "tf_static",
        "odom",
    ]


def test_lines_for_people(robot: Robot, answer_of: Answer) -> None:
    bridge = robot.bridge(policy=PublishPolicy(rate_hz=0.0))
    lines = []
    for answer in (
        answer_of(),
        answer_of(status="AMBIGUOUS"),
        UnreachableError("nobody"),
    ):
        robot.answer = answer
        robot.see(bridge, (len(lines) + 1) * S)
        published = bridge.step()
        assert published is not None
        lines.append(line_of(published))
    assert lines == [
        "1.000 LOCALIZED 0.950  x 10.00  y 20.00  heading 0.0  End",
        "2.000 AMBIGUOUS 0.950  (not published: AMBIGUOUS)",
        "3.000 failed: nobody",
    ]


@pytest.mark.parametrize(
    "wrong", [{"rate_hz": -1.0}, {"rate_hz": float("nan")}, {"min_confidence": 1.1}, {"min_confidence": -0.1}]
)
def test_a_gate_that_is_none_is_refused_with_its_option(wrong: dict[str, float]) -> None:
    with pytest.raises(RequestError, match=r"^--(rate|min-confidence): "):
        PublishPolicy(**wrong)
