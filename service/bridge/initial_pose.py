"""The pose that an operator or another node publishes, as the prior of the next queries."""

import math
from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np

from service.bridge.frames import plain, rigid_from
from service.bridge.notices import Notices
from service.bridge.odometry import OdometryPose
from service.bridge.pairs import nanoseconds_of
from service.bridge.pose import Covariance, StampedPose, about
from service.errors import RequestError
from service.geometry.rigid import Transform, heading_of_camera, inverse
from service.retrieval.prior import HEADING_STD_DEG, POSITION_STD_M, Prior

#: Least standard deviations of a prior, metres and degrees. A person places a pose on a picture of the map no better than this.
LEAST_STD_M, LEAST_STD_DEG = 1.0, 5.0
#: Motion that a prior allows for if no odometry is known: metres and radians per second.
SPEED_MPS, TURN_RADPS = 1.0, math.radians(20.0)
#: Number of own poses that are recognised.
_OWN = 100
#: Limits of the contract: coordinates of a prior and their standard deviation, metres. A wider heading than this is unknown, degrees.
_FARTHEST_M, _MOST_STD_M, _MOST_STD_DEG = 1e7, 1e6, 180.0


@dataclass(frozen=True, slots=True, eq=False)
class _Received:
    T_map_vehicle: Transform
    covariance: Covariance
    at_s: float
    body: OdometryPose | None


class InitialPoses:
    """Keeps the newest geometry_msgs/PoseWithCovarianceStamped of a topic until it is too old, or an answer is published.

    Args:
        topic: named in warnings.
        frame_id: of the map.
        most_age_s: age after which a pose is dropped, seconds.
        notices: takes warnings.

    Attributes:
        count: number of usable poses so far.

    Raises:
        RequestError: the age is out of bounds.
    """

    def __init__(self, topic: str, frame_id: str, most_age_s: float, notices: Notices) -> None:
        if not 0 < most_age_s < math.inf:
            raise RequestError(
                f"--prior-age: {most_age_s:g} is not a valid age; give seconds, such as 30, or switch the prior off by "
                '--prior-topic ""',
                field="prior_age",
            )
        self._topic, self._frame_id, self._most_age_s, self._notices = topic, plain(frame_id), most_age_s, notices
        self._own: deque[tuple[int, float, float]] = deque(maxlen=_OWN)
        self._received: _Received | None = None
        self.count = 0

    def add(self, message: Any, now_s: float, body: OdometryPose | None) -> None:
        """Take a pose, unless this bridge published it.

        Args:
            message: geometry_msgs/PoseWithCovarianceStamped: the vehicle in the map.
            now_s: current time of a monotonic clock, s. The stamp of the message may come from another machine.
            body: newest pose of the odometry; None if it is unknown.
        """
        at = message.pose.pose.position
        if (nanoseconds_of(message), at.x, at.y) in self._own:
            return
        frame = plain(message.header.frame_id)
        T_map_vehicle = rigid_from(at, message.pose.pose.orientation)
        if frame != self._frame_id:
            self._notices.warn(
                f"{self._topic}: a pose has the frame {frame!r}, not the frame of the map, {self._frame_id!r}, so the bridge does not use "
                "it; publish it in the frame of the map, or name that frame by --frame"
            )
            return
        if T_map_vehicle is None or np.abs(T_map_vehicle[:2, 3]).max() > _FARTHEST_M:
            self._notices.warn(
                f"{self._topic}: a pose is not finite or beyond {_FARTHEST_M:g} m, or its quaternion is no rotation, so the bridge does "
                "not use it; correct the publisher"
            )
            return
        covariance = np.array(message.pose.covariance, np.float64).reshape(6, 6)
        if not np.isfinite(covariance).all():
            covariance = np.zeros((6, 6))  # unknown
        self._received = _Received(T_map_vehicle, covariance, now_s, body)
        self.count += 1

    def published(self, pose: StampedPose) -> None:
        """Drop the pose: an answer replaces it. Remember the answer, which may come back on the same topic.

        Args:
            pose: published by this bridge.
        """
        x, y = pose.T_map_vehicle[:2, 3].tolist()
        self._own.append((pose.stamp_ns, x, y))
        self._received = None

    def prior(
        self, T_vehicle_camera: Transform, body: OdometryPose | None, T_body_camera: Transform | None, now_s: float
    ) -> tuple[Prior, float] | None:
        """Return the prior of a query and its age in seconds; None if there is no fresh pose.

        With odometry the pose moves with the robot. Without it, its standard deviations grow with its age.

        Args:
            T_vehicle_camera: mounting, metres.
            body: pose of the odometry at the image; None if it is unknown.
            T_body_camera: from the camera frame to the odometry's body, metres; None if it is unknown.
            now_s: current time of a monotonic clock, s.
        """
        received = self._received
        if received is None:
            return None
        age_s = max(0.0, now_s - received.at_s)
        if age_s > self._most_age_s:
            self._received = None
            return None
        T = received.T_map_vehicle @ T_vehicle_camera
        covariance = about(received.covariance, T[:3, 3] - received.T_map_vehicle[:3, 3])
        grown_m, grown_rad = SPEED_MPS * age_s, TURN_RADPS * age_s
        before = received.body
        if T_body_camera is not None and body is not None and before is not None and body.session == before.session:
            T = T @ inverse(before.T_odom @ T_body_camera) @ body.T_odom @ T_body_camera
            grown_m = grown_rad = 0.0
        prior = Prior(
            position_m=T[:2, 3].copy(),
            position_std_m=_std_m(covariance, grown_m),
            heading_rad=heading_of_camera(T),
            heading_std_rad=math.radians(_std_deg(covariance, grown_rad)),
        )
        return prior, age_s


def _std_m(covariance: Covariance, grown_m: float) -> float:
    """Return the larger standard deviation of x and y. Zeros mean that it is unknown."""
    variance = float(np.linalg.eigvalsh(covariance[:2, :2])[-1])
    if variance <= 0:
        return max(POSITION_STD_M, grown_m)
    return min(_MOST_STD_M, max(LEAST_STD_M, math.sqrt(variance + grown_m**2)))


def _std_deg(covariance: Covariance, grown_rad: float) -> float:
    """Return the standard deviation of the heading, degrees. A variance of zero means that it is unknown."""
    variance = float(covariance[5, 5])
    if variance <= 0:
        return min(_MOST_STD_DEG, max(HEADING_STD_DEG, math.degrees(grown_rad)))
    return min(_MOST_STD_DEG, max(LEAST_STD_DEG, math.degrees(math.sqrt(variance + grown_rad**2))))
