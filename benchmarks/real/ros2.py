"""Send frames over DDS on loopback to a bridge in another process, as a robot does, and count the answers."""

import itertools
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from cyclonedds.core import InstanceState, ReadCondition, SampleState, ViewState, WaitSet
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration
from numpy.typing import NDArray

from service.bridge import messages
from service.bridge.bridge import Topics
from service.bridge.pairs import nanoseconds_of
from service.bridge.ros2 import dds_name, qos_of, stamp_message
from service.errors import UnreachableError
from service.geometry.camera import PinholeCamera

Pictures = tuple[NDArray[np.uint8], NDArray[np.float32], PinholeCamera]
#: Discovery and data use loopback only, without multicast, because some containers have no multicast.
LOOPBACK = """<CycloneDDS><Domain>
<General><Interfaces><NetworkInterface name="lo"/></Interfaces><AllowMulticast>false</AllowMulticast></General>
<Discovery><ParticipantIndex>auto</ParticipantIndex><Peers><Peer address="127.0.0.1"/></Peers></Discovery>
</Domain></CycloneDDS>"""
#: Largest number of frames without an answer. More would wait in queues.
_UNDER_WAY = 4
_FIRST_NS, _PERIOD_NS = 1_700_000_000 * 10**9, 10**8


def answers_over_dds(
    url_or_bundle: str, frames: Iterable[Pictures], count: int = 100, *, patience_s: float = 60.0
) -> int:
    """Send frames and return the number of answers: poses with the stamp of a frame, or diagnostics of an answer without a pose.

    The bridge is the real command, without limits of rate and confidence.

    Args:
        url_or_bundle: address of a service, or folder of a map bundle that the bridge answers from.
        frames: colour (H, W, 3), depth (H, W) in metres, and camera. They repeat if there are fewer than ``count``.
        count: number of frames to send.
        patience_s: longest wait without a message, seconds.

    Raises:
        UnreachableError: the bridge has ended, or sent no message.
    """
    domain = 20 + os.getpid() % 200  # two runs on one machine must not receive each other's messages
    with _bridge(url_or_bundle, domain) as process:
        robot = Robot(domain)
        robot.connect(process, patience_s)
        for number, frame in enumerate(itertools.islice(itertools.cycle(frames), count)):
            robot.send(frame, _FIRST_NS + number * _PERIOD_NS)
            if not robot.wait(lambda sent=number + 1: robot.queries > sent - _UNDER_WAY, patience_s):
                break
        robot.wait(lambda: robot.queries >= robot.sent and len(robot.posed) >= robot.published, patience_s)
    return len(robot.posed) + robot.refused


class Robot:
    """Robot that publishes the topics of a camera and receives poses and diagnostics.

    Args:
        domain: DDS domain.

    Attributes:
        posed: stamps of the received poses, nanoseconds.
        queries: number of queries that the bridge reports.
        published: number of poses that the bridge reports.
        refused: number of diagnostics of answers that are not LOCALIZED.
    """

    def __init__(self, domain: int) -> None:
        self._domain = Domain(domain, LOOPBACK)  # leaves the environment of this process unchanged
        self._participant = DomainParticipant(domain)
        topics = Topics()
        self._writers: list[Any] = []
        self._color = self.writer(topics.color, messages.Image)
        self._depth = self.writer(topics.depth, messages.Image)
        self._info = self.writer(topics.info, messages.CameraInfo)
        # This reader exists before that of the diagnostics. So a bridge that knows the second reader knows the first too.
        self._poses = self._of(DataReader, topics.pose, messages.PoseWithCovarianceStamped)
        self._diagnostics = self._of(DataReader, topics.diagnostics, messages.DiagnosticArray)
        self._waiting = WaitSet(self._participant)
        for reader in (self._poses, self._diagnostics):
            self._waiting.attach(ReadCondition(reader, SampleState.Any | ViewState.Any | InstanceState.Any))
        self.queries = self.published = self.refused = 0
        self._stamps: set[int] = set()
        self.posed: set[int] = set()
        self._has_diagnostics = False

    @property
    def sent(self) -> int:
        """Number of sent frames."""
        return len(self._stamps)

    @property
    def is_connected(self) -> bool:
        """Whether a bridge subscribes to all topics, and its diagnostics arrive."""
        return self._has_diagnostics and all(writer.get_matched_subscriptions() for writer in self._writers)

    def writer(self, topic: str, kind: type, *, latched: bool = False) -> Any:
        """Return a writer of another topic. The bridge must subscribe to this topic too, or the robot is not connected.

        Args:
            topic: name in ROS.
            kind: type of the messages.
            latched: a late reader gets the last messages too.
        """
        made = self._of(DataWriter, topic, kind, latched=latched)
        self._writers.append(made)
        return made

    def connect(self, process: "subprocess.Popen[bytes]", patience_s: float) -> None:
        """Wait until the bridge subscribes to all topics and its diagnostics arrive.

        Args:
            process: process of the bridge.
            patience_s: longest wait without a message, seconds.

        Raises:
            UnreachableError: the bridge has ended, or sends no diagnostics.
        """

        def is_ready() -> bool:
            if process.poll() is not None:
                raise UnreachableError(f"the bridge ended with {process.returncode}; see its messages above")
            return self.is_connected

        if not self.wait(is_ready, patience_s):
            raise UnreachableError(
                f"no message from the bridge within {patience_s:g} s; check that this machine has a loopback interface"
            )

    def send(self, frame: Pictures, stamp_ns: int) -> None:
        """Send one frame as a camera driver does.

        Args:
            frame: colour (H, W, 3), depth (H, W) in metres, and camera.
            stamp_ns: stamp of all messages, nanoseconds.
        """
        rgb, depth_m, camera = frame
        header = messages.Header(stamp_message(stamp_ns), "camera_color_optical_frame")
        k = [camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0]
        p = [*k[:3], 0.0, *k[3:6], 0.0, *k[6:], 0.0]
        self._stamps.add(stamp_ns)
        self._info.write(
            messages.CameraInfo(
                header=header, height=camera.height, width=camera.width, k=k, p=p, distortion_model="plumb_bob"
            )
        )
        self._color.write(_image(header, "rgb8", rgb))
        self._depth.write(_image(header, "32FC1", depth_m.astype("<f4", copy=False)))

    def wait(self, until: Any, patience_s: float) -> bool:
        """Receive messages until a condition holds; return False if no message arrives for ``patience_s``.

        Args:
            until: the condition, a function without arguments.
            patience_s: longest wait without a message, seconds.
        """
        last_message_s = time.monotonic()
        while not until():
            self._waiting.wait(duration(milliseconds=200))
            if self._receive():
                last_message_s = time.monotonic()
            elif time.monotonic() - last_message_s > patience_s:
                return False
        return True

    def _receive(self) -> bool:
        """Take the received messages; return whether they change the counts."""
        before = (self._has_diagnostics, self.queries, len(self.posed))
        for pose in self._poses.take(N=100):
            self.posed |= {nanoseconds_of(pose)} & self._stamps
        for array in self._diagnostics.take(N=100):
            self._has_diagnostics = True
            values = {value.key: value.value for value in array.status[0].values}
            self.queries, self.published = int(values["queries"]), int(values["published"])
            self.refused += values.get("status") in ("AMBIGUOUS", "OUT_OF_MAP")
        return (self._has_diagnostics, self.queries, len(self.posed)) != before

    def _of(self, end: Any, topic: str, kind: type, *, latched: bool = False) -> Any:
        return end(
            self._participant,
            Topic(self._participant, dds_name(topic), kind),
            qos=qos_of(reliable=True, depth=0, latched=latched),
        )


def _image(header: messages.Header, encoding: str, picture: NDArray[Any]) -> messages.Image:
    height, width = picture.shape[:2]
    data = np.ascontiguousarray(picture).tobytes()
    return messages.Image(
        header=header, height=height, width=width, encoding=encoding, step=len(data) // height, data=data
    )


@contextmanager
def _bridge(url_or_bundle: str, domain: int) -> "Iterator[subprocess.Popen[bytes]]":
    """Run the command in its own process; SIGINT ends it."""
    where = ["--url" if "://" in url_or_bundle else "--map", url_or_bundle]
    # The robot publishes images only.
    open_gates = ["--rate", "0", "--min-confidence", "0", "--reliable", "--queue", "0", "--tf-static-topic", ""]
    process = subprocess.Popen(
        [
            sys.executable,
            "-c",
            "from service.cli.main import main; main()",
            "bridge",
            "ros2",
            *where,
            "--domain",
            str(domain),
            *open_gates,
        ],
        env=os.environ | {"CYCLONEDDS_URI": LOOPBACK},
        stdout=subprocess.DEVNULL,
    )
    try:
        yield process
    finally:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(timeout=30)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
