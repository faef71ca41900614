"""The rclpy node with a fake rclpy: its subscriptions, its publishers, and how it ends."""

from collections.abc import Callable
from threading import Event
from typing import Any

import numpy as np
import pytest

from service.bridge import rclpy_node
from service.bridge.bridge import Bridge, Published, Topics
from service.bridge.gravity import Imu
from service.bridge.initial_pose import InitialPoses
from service.bridge.notices import Notices
from service.bridge.odometry import Odometry
from service.bridge.publish_policy import PublishPolicy
from service.bridge.robot import Robot
from service.contract.schema import LocalizeAnswer
from service.errors import ExtraMissingError

S = 10**9


def test_pictures_in_a_pose_and_a_diagnosis_out(
    ros: Any, image_of: Callable[..., Any], info_of: Callable[..., Any], answer_of: Callable[..., LocalizeAnswer]
) -> None:
    bridge = Bridge(localize=lambda *_: answer_of(), policy=PublishPolicy(rate_hz=0.0), clock=lambda: 0.0)
    topics, told = bridge.topics, list[Published]()

    def see() -> None:
        ros.subscriptions[topics.info].heard(info_of(0))
        ros.subscriptions[topics.color].heard(image_of(np.zeros((4, 6, 3), np.uint8), "rgb8", 5 * S + 7))
        ros.subscriptions[topics.depth].heard(image_of(np.ones((4, 6), np.float32), "32FC1", 5 * S + 7))

    ros.turns = [see]
    rclpy_node.run(bridge, ros.over, told.append, domain=3, reliable=True, depth=0)
    (pose,) = ros.published["/initialpose"]
    assert (pose.header.stamp.sec, pose.header.stamp.nanosec, pose.header.frame_id) == (5, 7, "map")
    assert (pose.pose.pose.position.x, pose.pose.pose.orientation.w) == (10.0, pytest.approx(1.0))
    assert len(pose.pose.covariance) == 36
    (array,) = ros.published["/diagnostics"]
    assert (array.header.stamp, array.status[0].level) == ("now", b"\x00")
    assert {"queries", "rate_hz"} < {value.key for value in array.status[0].values}
    assert len(told) == 1
    assert (ros.domain, ros.signals, ros.ended) == (3, "no handlers", ["node", "shutdown"])


@pytest.mark.parametrize(
    ("reliable", "depth", "wanted"),
    [(True, 0, ("reliable", "all", 1000)), (False, 5, ("best effort", "last", 5))],
)
def test_image_subscriptions_follow_the_settings(
    ros: Any, reliable: bool, depth: int, wanted: tuple[str, str, int]
) -> None:
    rclpy_node.run(Bridge(localize=lambda *_: pytest.fail("asked")), ros.over, reliable=reliable, depth=depth)
    for subscription in ros.subscriptions.values():
        assert (subscription.qos.reliability, subscription.qos.history, subscription.qos.depth) == wanted


def test_other_topics_are_received_as_they_are_published(ros: Any) -> None:
    notices = Notices()
    robot = Robot(
        odometry=Odometry("/odom", notices),
        imu=Imu("/imu", notices),
        initial_poses=InitialPoses("/initialpose", "map", 30.0, notices),
    )
    topics = Topics(tf_static="/tf_static", odom="/odom", imu="/imu", prior="/initialpose")
    rclpy_node.run(
        Bridge(localize=lambda *_: pytest.fail("asked"), topics=topics, robot=robot), ros.over, reliable=True
    )
    told = {}
    for topic in ("/tf_static", "/odom", "/imu", "/initialpose"):
        each = ros.subscriptions[topic]
        kind = each.kind if isinstance(each.kind, str) else each.kind.__name__
        told[topic] = (kind, each.qos.reliability, each.qos.durability, each.qos.history, each.qos.depth)
    assert told == {
        "/tf_static": ("TFMessage", "reliable", "latched", "all", 1000),
        "/odom": ("Odometry", "best effort", "volatile", "last", 500),
        "/imu": ("Imu", "best effort", "volatile", "last", 500),
        "/initialpose": ("posed_message", "reliable", "volatile", "last", 10),
    }
    assert ros.subscriptions["/camera/color/image_raw"].qos.durability == "volatile"


def test_silence_is_reported_once_per_second(ros: Any) -> None:
    now_s = [0.0]
    bridge = Bridge(localize=lambda *_: pytest.fail("asked"), policy=PublishPolicy(rate_hz=0.0), clock=lambda: now_s[0])

    def later() -> None:
        now_s[0] += 0.5

    ros.turns = [later] * 4
    rclpy_node.run(bridge, ros.over)
    assert [array.status[0].level for array in ros.published["/diagnostics"]] == [b"\x01"] * 2


def test_the_node_is_taken_down_when_something_breaks(ros: Any) -> None:
    def broken() -> None:
        raise RuntimeError("spin")

    ros.turns = [broken]
    with pytest.raises(RuntimeError, match="spin"):
        rclpy_node.run(Bridge(localize=lambda *_: pytest.fail("asked")), ros.over)
    assert ros.ended == ["node", "shutdown"]


def test_without_ros_the_remedy_is_reported() -> None:
    with pytest.raises(ExtraMissingError, match=r"'rclpy', which comes with ROS 2: source .*--node dds"):
        rclpy_node.run(Bridge(localize=lambda *_: pytest.fail("asked")), Event())
