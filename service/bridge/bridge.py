"""The bridge, independent of the middleware: takes images, returns poses and diagnoses."""

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.bridge.diagnostics import Counts, Diagnosis, Level, of_answer
from service.bridge.known import Known
from service.bridge.odometry import ODOMETRY_WAIT_S
from service.bridge.pairs import Pair, Pairs, nanoseconds_of
from service.bridge.pictures import camera_from, depth_from, is_rectified_by_name, rgb_from
from service.bridge.pose import StampedPose, pose_of
from service.bridge.publish_policy import PublishPolicy
from service.bridge.robot import Robot
from service.contract.schema import LocalizeAnswer
from service.errors import StreetfixError
from service.geometry.camera import PinholeCamera

#: Localizes an RGB image (H, W, 3) and a depth image (H, W) in metres with their intrinsics and what is known beside them: by a client,
#: or by the pipeline in this process.
Localize = Callable[[NDArray[np.uint8], NDArray[np.float32], PinholeCamera, Known], LocalizeAnswer]
#: Number of queries over which the reported rate is averaged.
_RECENT = 10
#: Longest time without images and without a diagnosis, seconds; a slow query rate makes it longer.
IDLE_S = 1.0


@dataclass(frozen=True, slots=True)
class Topics:
    """ROS names of the topics. An empty name: there is no such topic.

    Attributes:
        color: RGB images, input.
        depth: depth images registered to the RGB images, input.
        info: calibration of the RGB camera, input.
        pose: poses, output.
        diagnostics: diagnoses, output.
        right_info: calibration of the stereo rig's right camera, input.
        tf_static: fixed transforms, input.
        odom: odometry, input.
        imu: orientation of an IMU, input.
        prior: poses that become the prior, input.
    """

    color: str = "/camera/color/image_raw"
    depth: str = "/camera/aligned_depth_to_color/image_raw"
    info: str = "/camera/color/camera_info"
    pose: str = "/initialpose"
    diagnostics: str = "/diagnostics"
    right_info: str = ""
    tf_static: str = ""
    odom: str = ""
    imu: str = ""
    prior: str = ""


@dataclass(frozen=True, slots=True)
class Delivery:
    """How a topic without images is received.

    Attributes:
        depth: length of the message queue; 0 keeps all.
        reliable: lost messages are sent again. Best-effort publishers are then not heard.
        latched: messages from before the subscription arrive too (transient local).
    """

    depth: int
    reliable: bool = False
    latched: bool = False


#: By the attribute of ``Topics``. The other input topics are received as the settings say. An odometry of 100 Hz sends 500 messages in the
#: longest usual query.
DELIVERIES = {
    "tf_static": Delivery(0, reliable=True, latched=True),
    "odom": Delivery(500),
    "imu": Delivery(500),
    "prior": Delivery(10, reliable=True),
}


@dataclass(frozen=True, slots=True)
class Published:
    """The result of one image pair.

    Attributes:
        pose: to publish; None if there is none.
        diagnosis: to publish.
        answer: of the service; None if there was an error.
        warnings: for the operator. Each appears once.
    """

    pose: StampedPose | None
    diagnosis: Diagnosis
    answer: LocalizeAnswer | None
    warnings: tuple[str, ...] = ()


@dataclass(slots=True, kw_only=True)
class Bridge:
    """Pairs images, sends queries, and decides what to publish.

    Attributes:
        localize: answers a query; a ``StreetfixError`` becomes a diagnosis.
        topics: named in messages.
        policy: query rate, and which answers are published.
        pairs: received images and calibrations.
        robot: what is known beside the images.
        frame_id: of the map.
        rectified: see ``camera_from``. The name of the colour topic can say the same.
        clock: monotonic time, s.
        counts: since the start.
    """

    localize: Localize
    topics: Topics = field(default_factory=Topics)
    policy: PublishPolicy = field(default_factory=PublishPolicy)
    pairs: Pairs = field(default_factory=Pairs)
    robot: Robot = field(default_factory=Robot)
    frame_id: str = "map"
    rectified: bool = False
    clock: Callable[[], float] = time.monotonic
    counts: Counts = field(default_factory=Counts)
    _recent_s: deque[float] = field(default_factory=lambda: deque(maxlen=_RECENT))
    _late_since_s: float | None = None

    def handlers(self) -> dict[str, Callable[[Any], None]]:
        """Return the functions that take messages, by the topic to subscribe to (attribute of ``Topics``)."""
        all_handlers: dict[str, Callable[[Any], None]] = {
            "color": self.pairs.color,
            "depth": self.pairs.depth,
            "info": self.pairs.info,
        }
        all_handlers |= self.robot.handlers(self.clock)
        return {name: handler for name, handler in all_handlers.items() if getattr(self.topics, name)}

    def wait_s(self) -> float:
        """Return the seconds until the next query is due. Until then messages need not be read."""
        return self.policy.wait_s(self.clock())

    def step(self) -> Published | None:
        """Send a query for the newest pair, if there is one and a query is due; else return None.

        Without a rate limit it takes the oldest pair, so that every pair has its turn. It blocks until the answer arrives.
        A pair waits a little for its odometry, and the first pairs for the mounting of the camera in TF.
        """
        if self.wait_s() > 0 or self.robot.missing() or self._waits_for_tf():
            return None
        pair = self._taken()
        return None if pair is None else self._ask(pair)

    def quiet_s(self) -> float:
        """Return the longest time without a query, seconds, that is no lack of images: ``IDLE_S``, or two periods of a slow rate."""
        return max(IDLE_S, 2.0 / self.policy.rate_hz) if self.policy.rate_hz else IDLE_S

    def idle(self) -> Diagnosis:
        """Build the diagnosis for a time without image pairs."""
        missing = (*self.pairs.missing(), *self.robot.missing())
        if missing:
            listed = ", ".join(f"{name} ({getattr(self.topics, name)})" for name in missing)
            message = f"no messages on {listed}; check that the topics have publishers"
        elif self._waits_for_tf():
            message = f"waiting for the mounting of the camera {self.pairs.camera_frame()!r} on {self.topics.tf_static}"
        else:
            message = "no colour and depth image with matching stamps; synchronise the publishers, or raise --tolerance"
        return Diagnosis(0, Level.WARN, message, self._counted())

    def _waits_for_tf(self) -> bool:
        camera_frame = self.pairs.camera_frame()
        return camera_frame is not None and self.robot.waits_for_tf(camera_frame, self.clock())

    def _taken(self) -> Pair | None:
        """Take a pair whose odometry is there, or that has waited for it long enough."""
        take = self.pairs.newest if self.policy.rate_hz else self.pairs.oldest
        pair = take(self.robot.is_ready)
        if pair is None and self.pairs.has_pair():
            now_s = self.clock()
            if self._late_since_s is None:
                self._late_since_s = now_s
            if now_s - self._late_since_s < ODOMETRY_WAIT_S:
                return None
            self.robot.stop_waiting()
            pair = take()
        self._late_since_s = None
        return pair

    def _ask(self, pair: Pair) -> Published:
        stamp_ns, began = nanoseconds_of(pair.color), self.clock()
        self.policy.record_query(began)
        self._recent_s.append(began)
        self.counts.queries += 1
        try:
            rectified = self.rectified or is_rectified_by_name(self.topics.color)
            camera = camera_from(pair.info, self.topics.info, rectified=rectified)
            rgb, depth_m = rgb_from(pair.color, self.topics.color), depth_from(pair.depth, self.topics.depth)
            facts = self.robot.facts(stamp_ns, str(pair.color.header.frame_id), began)
            answer = self.localize(rgb, depth_m, camera, facts.known)
        except StreetfixError as error:
            self.counts.failed += 1
            diagnosis = Diagnosis(stamp_ns, Level.ERROR, error.message, self._counted())
            return Published(None, diagnosis, None, self.robot.notices.take())
        self.counts.answered += 1
        self.robot.answered(facts)
        why_not = self.policy.why_not(answer)
        pose = None
        if not why_not:
            pose = pose_of(answer, facts.mounting.T_vehicle_camera, stamp_ns=stamp_ns, frame_id=self.frame_id)
            self.robot.published(pose)
            self.counts.published += 1
        latency_s = self.clock() - began
        told = (*facts.values, *self._counted())
        diagnosis = of_answer(answer, why_not, stamp_ns=stamp_ns, latency_s=latency_s, counted=told)
        return Published(pose, diagnosis, answer, self.robot.notices.take())

    def _counted(self) -> tuple[tuple[str, str], ...]:
        return self.counts.values(self.pairs.dropped, self._rate_hz())

    def _rate_hz(self) -> float:
        span_s = self._recent_s[-1] - self._recent_s[0] if len(self._recent_s) > 1 else 0.0
        return (len(self._recent_s) - 1) / span_s if span_s > 0 else 0.0


def line_of(published: Published) -> str:
    """Format the result of one image pair as a line of text.

    Args:
        published: the result.
    """
    answer, diagnosis = published.answer, published.diagnosis
    at = f"{diagnosis.stamp_ns / 1e9:.3f}"
    if answer is None:
        return f"{at} failed: {diagnosis.message}"
    pose, confidence = answer.pose, answer.confidence
    street = "" if answer.street is None else f"  {answer.street.name}"
    sure = "" if confidence is None else f" {confidence:.3f}"
    reason = "" if published.pose is not None else f"  ({diagnosis.message})"
    where = ""
    if pose is not None:
        where = f"  x {pose.position.x:.2f}  y {pose.position.y:.2f}  heading {pose.heading_deg:.1f}{street}"
    return f"{at} {answer.status}{sure}{where}{reason}"
