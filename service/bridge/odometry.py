"""Odometry of the robot: where its body is in a frame that drifts, but never jumps."""

from dataclasses import dataclass
from typing import Any

from service.bridge.frames import plain, rigid_from
from service.bridge.notices import Notices
from service.bridge.pairs import nanoseconds_of
from service.bridge.pose_history import PoseHistory
from service.geometry.rigid import Transform

#: Longest wait for the odometry of an image pair, seconds. Odometry often arrives a little later than the images.
ODOMETRY_WAIT_S = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class OdometryPose:
    """Pose in the frame of the odometry.

    Attributes:
        T_odom: from the posed frame to that of the odometry, (4, 4), metres.
        session: of the odometry. Poses of two sessions are not related.
    """

    T_odom: Transform
    session: int


class Odometry:
    """Poses of nav_msgs/Odometry.

    Args:
        topic: named in warnings.
        notices: takes warnings.

    Attributes:
        body_frame: frame whose pose the messages give (``child_frame_id``); empty if they do not name it.
    """

    def __init__(self, topic: str, notices: Notices) -> None:
        self._topic, self._notices = topic, notices
        self._poses = PoseHistory()
        self._odom_frame = self.body_frame = ""
        self._is_late = False

    def add(self, message: Any) -> None:
        """Add a pose.

        Args:
            message: nav_msgs/Odometry.
        """
        T_odom_body = rigid_from(message.pose.pose.position, message.pose.pose.orientation)
        if T_odom_body is None:
            self._notices.warn(
                f"{self._topic}: a pose is not finite, or its quaternion is no rotation, so the bridge skips such messages; correct "
                "the publisher, or name another --odom-topic"
            )
            return
        frames = plain(message.header.frame_id), plain(message.child_frame_id)
        if frames != (self._odom_frame, self.body_frame):
            self._odom_frame, self.body_frame = frames
            self._poses.restart()
        self._poses.add(nanoseconds_of(message), T_odom_body)
        self._is_late = False

    def is_ready(self, stamp_ns: int) -> bool:
        """Return whether waiting longer gives nothing: the pose at this time is there, or no odometry comes.

        Args:
            stamp_ns: the time, ns.
        """
        newest_ns = self._poses.newest_ns
        return newest_ns is None or self._is_late or newest_ns >= stamp_ns

    def stop_waiting(self) -> None:
        """Let ``is_ready`` be true until the next message."""
        self._is_late = True

    def at(self, stamp_ns: int) -> OdometryPose | None:
        """Return the pose of the body at a time; None if it is unknown.

        Args:
            stamp_ns: the time, ns.
        """
        return self._posed(self._poses.at(stamp_ns))

    def newest(self) -> OdometryPose | None:
        """Return the newest pose of the body; None without a message."""
        return self._posed(self._poses.newest())

    def _posed(self, T_odom_body: Transform | None) -> OdometryPose | None:
        return None if T_odom_body is None else OdometryPose(T_odom_body, self._poses.session)
