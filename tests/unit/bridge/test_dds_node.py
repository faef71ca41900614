"""The DDS node in this process, with a robot that speaks to it by real DDS on loopback."""

import os
import threading
from collections.abc import Callable
from typing import Any

import pytest

pytest.importorskip("cyclonedds", reason="it has no wheel for this Python or processor")

from benchmarks.real.ros2 import Robot
from service.bridge import messages
from service.bridge.known import Known
from service.bridge.opening import opened
from service.bridge.ros2 import DdsNode
from service.bridge.settings import BridgeSettings
from service.contract.schema import LocalizeAnswer
from service.imaging.level import GivenHeight

OPTICAL = "camera_color_optical_frame"


def posed(x: float) -> messages.PoseWithCovariance:
    return messages.PoseWithCovariance(messages.Pose(messages.Point(x, 0.0, 0.0)))


def test_what_a_robot_publishes_reaches_the_queries(answer_of: Callable[..., LocalizeAnswer], pictures: Any) -> None:
    """The mounting was published before the bridge starts. The camera is 0.5 m ahead of the vehicle. The bridge publishes on the topic of
    the prior, so it gets its own poses back. They are no prior."""
    domain = 20 + os.getpid() % 200
    robot = Robot(domain)
    tf = robot.writer("/tf_static", messages.TFMessage, latched=True)
    mounting = messages.Transform(messages.Vector3(0.5, 0.0, 0.4), messages.Quaternion(-0.5, 0.5, -0.5, 0.5))
    header = messages.Header(frame_id="base_footprint")
    tf.write(messages.TFMessage([messages.TransformStamped(header, OPTICAL, mounting)]))
    odom = robot.writer("/odom", messages.Odometry)
    prior = robot.writer("/initialpose", messages.PoseWithCovarianceStamped)
    asked, over = list[Known](), threading.Event()

    def answer(*given: Any) -> LocalizeAnswer:
        asked.append(given[-1])
        return answer_of()

    with opened(BridgeSettings(base_frame="base_footprint", rate=0.0, min_confidence=0.0)) as bridge:
        bridge.localize = answer
        node = DdsNode(bridge, domain=domain, reliable=True, depth=0)
        thread = threading.Thread(target=node.run, args=(over,))
        thread.start()
        poses = bridge.robot.initial_poses
        assert poses is not None
        try:
            assert robot.wait(lambda: robot.is_connected, 60.0)
            prior.write(messages.PoseWithCovarianceStamped(messages.Header(frame_id="map"), posed(7.0)))
            assert robot.wait(lambda: poses.count == 1, 60.0)
            for second in (1, 2, 3):
                header = messages.Header(messages.Time(second, 0), "odom")
                odom.write(messages.Odometry(header, "base_footprint", posed(float(second))))
                robot.send(pictures, second * 10**9)
                assert robot.wait(lambda sent=second: len(robot.posed) == sent, 60.0)
        finally:
            over.set()
            thread.join()
    assert [known.camera_height for known in asked] == [GivenHeight(0.4, 0.1)] * 3
    given = [None if known.prior is None else known.prior.position_m for known in asked]
    assert [None if each is None else each.tolist() for each in given] == [[7.5, 0.0], None, None]
    steps = [None if known.motion is None else known.motion.T_previous_camera for known in asked]
    assert [None if T is None else T[:3, 3].tolist() for T in steps] == [None, [0.0, 0.0, 1.0], [0.0, 0.0, 1.0]]
    assert poses.count == 1
