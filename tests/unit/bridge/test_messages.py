"""The byte layout of ROS 2 messages. The oracle is the definitions and the writer of rosbags."""

from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

pytest.importorskip("cyclonedds", reason="it has no wheel for this Python or processor")

from service.bridge import messages
from service.bridge.diagnostics import Diagnosis, Level
from service.bridge.pose import StampedPose
from service.bridge.ros2 import dds_name, diagnostics_message, pose_message, qos_of, stamp_message

STORE = get_typestore(Stores.ROS2_HUMBLE)
HEADER = messages.Header(messages.Time(1, 2), "camera")
POSE = StampedPose(5_000_000_007, "map", np.eye(4), np.arange(36.0).reshape(6, 6))
TOLD = Diagnosis(0, Level.WARN, "why", (("queries", "3"), ("rate_hz", "1.00")))
MADE: list[Any] = [
    messages.Image(HEADER, 2, 3, "rgb8", 1, 9, bytes(range(18))),
    messages.Image(),
    messages.CameraInfo(
        HEADER,
        4,
        6,
        "plumb_bob",
        [0.1, 0.2],
        list(range(9)),
        list(range(9)),
        list(range(12)),
        1,
        2,
        messages.RegionOfInterest(1, 2, 3, 4, True),
    ),
    messages.TFMessage(
        [
            messages.TransformStamped(
                HEADER,
                "optical",
                messages.Transform(messages.Vector3(1, 2, 3), messages.Quaternion(0.5, -0.5, 0.5, -0.5)),
            ),
            messages.TransformStamped(),
        ]
    ),
    messages.Odometry(
        HEADER,
        "base_link",
        messages.PoseWithCovariance(
            messages.Pose(messages.Point(1, 2, 3), messages.Quaternion(4, 5, 6, 7)), list(range(36))
        ),
        messages.TwistWithCovariance(
            messages.Twist(messages.Vector3(1, 2, 3), messages.Vector3(4, 5, 6)), list(range(36, 72))
        ),
    ),
    messages.Imu(
        HEADER,
        messages.Quaternion(1, 2, 3, 4),
        list(range(9)),
        messages.Vector3(5, 6, 7),
        list(range(9, 18)),
        messages.Vector3(8, 9, 10),
        list(range(18, 27)),
    ),
    pose_message(POSE),
    diagnostics_message(TOLD),
]


def ros_name(message: Any) -> str:
    """Convert sensor_msgs.msg.dds_.Image_ to sensor_msgs/msg/Image."""
    package, msg, _, name = message.__idl_typename__.split(".")
    return f"{package}/{msg}/{name.removesuffix('_')}"


@pytest.mark.parametrize("message", MADE, ids=lambda message: type(message).__name__)
def test_ros_reads_our_bytes_correctly(message: Any) -> None:
    read = STORE.deserialize_cdr(message.serialize(), ros_name(message))
    same(read, message)


@pytest.mark.parametrize("message", MADE, ids=lambda message: type(message).__name__)
def test_ros_own_bytes_are_ours(message: Any) -> None:
    name = ros_name(message)
    written = bytes(STORE.serialize_cdr(STORE.deserialize_cdr(message.serialize(), name), name))
    ours = message.serialize()
    assert ours[: len(written)] == written
    assert not any(ours[len(written) :])  # padding at most
    same(type(message).deserialize(written), message)


def same(read: Any, message: Any) -> None:
    """Compare field by field. A name or an order that differs from ROS fails here."""
    for name in message.__dataclass_fields__:
        ours, theirs = getattr(message, name), getattr(read, name)
        if hasattr(ours, "__dataclass_fields__"):
            same(theirs, ours)
        elif isinstance(ours, (list, tuple)) and ours and hasattr(ours[0], "__dataclass_fields__"):
            for each, other in zip(ours, theirs, strict=True):
                same(other, each)
        elif isinstance(ours, (list, tuple, bytes)):
            assert list(theirs) == list(ours), name
        else:
            assert theirs == ours, name


@pytest.mark.parametrize("message", MADE, ids=lambda message: type(message).__name__)
def test_type_names_are_those_that_rosidl_gives(message: Any) -> None:
    package = message.__idl_typename__.split(".")[0]
    assert message.__idl_typename__ == f"{package}.msg.dds_.{type(message).__name__}_"
    assert ros_name(message) in STORE.fielddefs


@pytest.mark.parametrize("topic", ["/camera/color/image_raw", "camera/color/image_raw"])
def test_topics_are_named_as_rmw_does(topic: str) -> None:
    assert dds_name(topic) == "rt/camera/color/image_raw"


def test_a_pose_is_in_the_message_as_ros_has_it() -> None:
    T = np.eye(4)
    T[:3, 3] = (1.0, 2.0, 3.0)
    message = pose_message(StampedPose(5_000_000_007, "map", T, np.arange(36.0).reshape(6, 6)))
    assert (message.header.stamp.sec, message.header.stamp.nanosec, message.header.frame_id) == (5, 7, "map")
    at, turned = message.pose.pose.position, message.pose.pose.orientation
    assert (at.x, at.y, at.z, turned.x, turned.y, turned.z, turned.w) == (1, 2, 3, 0, 0, 0, 1)
    assert message.pose.covariance[7] == 7.0


def test_a_diagnosis_is_in_the_message_as_ros_has_it() -> None:
    (status,) = diagnostics_message(TOLD).status
    assert (status.level, status.name, status.message) == (1, "streetfix: localization", "why")
    assert [(value.key, value.value) for value in status.values] == [("queries", "3"), ("rate_hz", "1.00")]


def test_stamps_of_today_fit() -> None:
    assert stamp_message(1_795_000_000_999_999_999) == messages.Time(1_795_000_000, 999_999_999)


@pytest.mark.parametrize(("reliable", "depth"), [(True, 0), (False, 5)])
def test_qualities_of_service_are_written_as_ros_speaks(reliable: bool, depth: int) -> None:
    told = str(qos_of(reliable=reliable, depth=depth))
    assert ("Reliable" in told) == reliable
    assert ("KeepAll" in told) == (depth == 0)
    assert "use_cdrv0_representation=True" in told
    assert "Volatile" in told


def test_a_latched_topic_also_gives_earlier_messages() -> None:
    assert "TransientLocal" in str(qos_of(reliable=True, depth=0, latched=True))
