"""The bridge over DDS, the protocol of ROS 2. This side needs no ROS installation."""

import time
from collections.abc import Callable, Collection
from threading import Event
from typing import TypeVar

from cyclonedds.core import DDSException, InstanceState, Policy, Qos, ReadCondition, SampleState, ViewState, WaitSet
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from service.bridge import messages
from service.bridge.bridge import DELIVERIES, IDLE_S, Bridge, Published
from service.bridge.diagnostics import NAME, Diagnosis
from service.bridge.pose import StampedPose
from service.errors import AddressError
from service.runtime.wakeup import Wakeup

M = TypeVar("M", bound=IdlStruct)
#: Maximum seconds until a signal is noticed.
_LOOK_S = 0.2
#: Message types of the input topics, by the attribute of ``Topics``.
_KINDS: dict[str, type[IdlStruct]] = {
    "color": messages.Image,
    "depth": messages.Image,
    "info": messages.CameraInfo,
    "right_info": messages.CameraInfo,
    "tf_static": messages.TFMessage,
    "odom": messages.Odometry,
    "imu": messages.Imu,
    "prior": messages.PoseWithCovarianceStamped,
}
#: Number of messages that are taken from a reader at once.
_AT_ONCE = 100
#: Data representation of ROS 2 on the wire.
_CDR = Policy.DataRepresentation(use_cdrv0_representation=True)


def qos_of(*, reliable: bool, depth: int, latched: bool = False) -> Qos:
    """Build the quality of service of ROS 2.

    Args:
        reliable: send lost messages again. A best-effort reader also receives from reliable writers. A reliable reader does not
            receive from best-effort writers.
        depth: length of the message queue; 0 keeps all.
        latched: a late reader also gets the messages that a writer sent before (transient local).
    """
    history = Policy.History.KeepLast(depth) if depth else Policy.History.KeepAll
    reliability = Policy.Reliability.Reliable(duration(seconds=10)) if reliable else Policy.Reliability.BestEffort
    durability = Policy.Durability.TransientLocal if latched else Policy.Durability.Volatile
    return Qos(reliability, history, durability, _CDR)


def dds_name(topic: str) -> str:
    """Return the DDS name of a ROS topic.

    Args:
        topic: name in ROS.
    """
    return f"rt/{topic.strip('/')}"


class DdsNode:
    """DDS readers and writers of one bridge.

    Args:
        bridge: that processes the messages.
        domain: ``ROS_DOMAIN_ID`` of the robot.
        reliable: request lost images again. Sensor publishers are often best effort; a reliable reader does not receive them.
        depth: length of the image queue during a query; 0 keeps all.

    Raises:
        AddressError: DDS does not start, for example because of a wrong ``CYCLONEDDS_URI``.
    """

    def __init__(self, bridge: Bridge, *, domain: int = 0, reliable: bool = False, depth: int = 5) -> None:
        self._bridge = bridge
        topics = bridge.topics
        try:
            self._participant = DomainParticipant(domain)
            pictures = qos_of(reliable=reliable, depth=depth)
            others = {
                name: qos_of(reliable=each.reliable, depth=each.depth, latched=each.latched)
                for name, each in DELIVERIES.items()
            }
            self._readers = {
                name: self._reader(getattr(topics, name), _KINDS[name], others.get(name, pictures))
                for name in bridge.handlers()
            }
            self._pose = self._writer(topics.pose, messages.PoseWithCovarianceStamped)
            self._diagnostics = self._writer(topics.diagnostics, messages.DiagnosticArray)
            self._waiting = WaitSet(self._participant)
            for reader in self._readers.values():
                unread = ReadCondition(reader, SampleState.Any | ViewState.Any | InstanceState.Any)
                self._waiting.attach(unread)
        except DDSException as error:
            raise AddressError(
                f"DDS does not start on domain {domain} ({error}); check --domain and the environment's CYCLONEDDS_URI",
                field="domain",
            ) from error

    def run(self, over: Event | Wakeup, callback: Callable[[Published], None] = lambda _: None) -> None:
        """Process images and publish the results until ``over`` is set.

        Args:
            over: ends the loop; set from elsewhere, for example by a signal.
            callback: called with the result of every processed pair.
        """
        spoken_s = time.monotonic() - IDLE_S
        while not over.is_set():
            if (wait_s := self._bridge.wait_s()) > 0:  # no query is due, so images need not be unpacked
                self._take(DELIVERIES.keys())
                over.wait(min(wait_s, _LOOK_S))
            else:
                self._waiting.wait(duration(seconds=_LOOK_S))
                self._take(self._readers.keys())
                while not over.is_set() and (published := self._bridge.step()) is not None:
                    self._publish(published)
                    callback(published)
                    spoken_s = time.monotonic()
            if time.monotonic() - spoken_s >= self._bridge.quiet_s():
                self._say(self._bridge.idle())
                spoken_s = time.monotonic()

    def _take(self, names: Collection[str]) -> None:
        """Hand the messages of some topics to the bridge: of images the first few, of other topics all.

        The other topics come last, so the odometry from before an image is there with the image.
        """
        handlers = self._bridge.handlers()
        for name, reader in self._readers.items():
            if name not in names:
                continue
            at_once = _AT_ONCE if name in DELIVERIES else self._bridge.pairs.most
            while received := reader.take(N=at_once):
                for message in received:
                    handlers[name](message)
                if name not in DELIVERIES or len(received) < at_once:
                    break

    def _publish(self, published: Published) -> None:
        if published.pose is not None:
            self._pose.write(pose_message(published.pose))
        self._say(published.diagnosis)

    def _say(self, diagnosis: Diagnosis) -> None:
        self._diagnostics.write(diagnostics_message(diagnosis))

    def _reader(self, name: str, kind: type[M], qos: Qos) -> DataReader[M]:
        return DataReader(self._participant, Topic(self._participant, dds_name(name), kind), qos=qos)

    def _writer(self, name: str, kind: type[M]) -> DataWriter[M]:
        topic = Topic(self._participant, dds_name(name), kind)
        return DataWriter(self._participant, topic, qos=qos_of(reliable=True, depth=10))


def pose_message(pose: StampedPose) -> messages.PoseWithCovarianceStamped:
    """Convert a pose to geometry_msgs/PoseWithCovarianceStamped.

    Args:
        pose: of the vehicle.
    """
    x, y, z, w = pose.quaternion_xyzw.tolist()
    position = messages.Point(*pose.T_map_vehicle[:3, 3].tolist())
    posed = messages.Pose(position, messages.Quaternion(x, y, z, w))
    return messages.PoseWithCovarianceStamped(
        header=messages.Header(stamp_message(pose.stamp_ns), pose.frame_id),
        pose=messages.PoseWithCovariance(posed, pose.covariance.reshape(-1).tolist()),
    )


def diagnostics_message(diagnosis: Diagnosis) -> messages.DiagnosticArray:
    """Convert a diagnosis to diagnostic_msgs/DiagnosticArray, stamped with the current time.

    Args:
        diagnosis: to publish.
    """
    status = messages.DiagnosticStatus(
        level=int(diagnosis.level),
        name=NAME,
        message=diagnosis.message,
        hardware_id="streetfix",
        values=[messages.KeyValue(name, value) for name, value in diagnosis.values],
    )
    return messages.DiagnosticArray(header=messages.Header(stamp_message(time.time_ns())), status=[status])


def stamp_message(stamp_ns: int) -> messages.Time:
    """Convert a time stamp to builtin_interfaces/Time.

    Args:
        stamp_ns: POSIX time, ns.
    """
    return messages.Time(*divmod(stamp_ns, 10**9))
