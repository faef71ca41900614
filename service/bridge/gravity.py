"""Direction of gravity in the camera frame: from the mounting of the camera, or from an IMU."""

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from service.bridge.frames import StaticFrames, plain, rigid_from
from service.bridge.notices import Notices
from service.bridge.pairs import nanoseconds_of
from service.bridge.pose_history import PoseHistory
from service.geometry.rigid import Transform

Direction = Float64[NDArray[np.float64], "3"]
#: A mounting that is level within this angle says nothing that the service does not assume. Without gravity it also tries other
#: pitches, which helps if the mounting in TF is not accurate (decision 0193).
LEVEL_RAD = math.radians(2.0)
#: The service refuses a camera that looks up or down so steeply that no heading is left.
STEEPEST = math.cos(math.radians(20.0))
#: Longest time between an image and the nearest orientation of the IMU, seconds.
_HOLD_S = 0.1
#: An orientation has no position.
_NOWHERE = SimpleNamespace(x=0.0, y=0.0, z=0.0)


def down_on_vehicle(T_upright_camera: Transform | None, notices: Notices) -> Direction | None:
    """Return the downward direction of the vehicle in the camera frame; None if the camera is level or its mounting is unknown.

    The service levels an image with the ground under the vehicle. So on a slope the vehicle's downward axis is what it needs.

    Args:
        T_upright_camera: from the camera frame to a frame of the vehicle whose z axis points up; None if it is unknown.
        notices: takes warnings.
    """
    if T_upright_camera is None:
        return None
    down: Direction = -T_upright_camera[2, :3]
    if abs(down[2]) > STEEPEST:
        notices.warn(
            "--gravity mounting: by its mounting the camera looks straight up or down, so the bridge sends no gravity; check --mount, "
            "or that the images name an optical frame (x right, y down, z forward)"
        )
        return None
    return None if math.hypot(down[0], down[2]) < math.sin(LEVEL_RAD) and down[1] > 0 else down


class Imu:
    """Orientations of an IMU (sensor_msgs/Imu).

    The acceleration is not read: if a robot brakes with 1 m/s2, its direction is 5.8 degrees off.

    Args:
        topic: named in warnings.
        notices: takes warnings.
    """

    def __init__(self, topic: str, notices: Notices) -> None:
        self._topic, self._notices = topic, notices
        self._orientations = PoseHistory()
        self._frame = ""

    def add(self, message: Any) -> None:
        """Add an orientation.

        Args:
            message: sensor_msgs/Imu. A first covariance of -1 means that it has no orientation.
        """
        T_world_imu = rigid_from(_NOWHERE, message.orientation)
        if T_world_imu is None or message.orientation_covariance[0] == -1:
            self._notices.warn(
                f"{self._topic}: the messages have no orientation, so the bridge sends no gravity; run a filter such as "
                "imu_filter_madgwick and name its --imu-topic, or pass --gravity mounting"
            )
            return
        self._frame = plain(message.header.frame_id)
        self._orientations.add(nanoseconds_of(message), T_world_imu)

    def down(self, stamp_ns: int, camera_frame: str, frames: StaticFrames) -> Direction | None:
        """Return the direction of gravity in the camera frame; None if it is unknown.

        Args:
            stamp_ns: of the image, ns.
            camera_frame: frame of the image.
            frames: of the robot.
        """
        T_world_imu = self._orientations.at(stamp_ns, hold_s=_HOLD_S)
        if T_world_imu is None:
            return None
        T_camera_imu = frames.transform(camera_frame, self._frame)
        if T_camera_imu is None:
            self._notices.warn(
                f"{self._topic}: TF has no fixed transform from {self._frame!r} to {camera_frame!r}, so the bridge sends no gravity; "
                "publish the mounting of the IMU on /tf_static, or pass --gravity mounting"
            )
            return None
        down: Direction = -T_camera_imu[:3, :3] @ T_world_imu[2, :3]
        if abs(down[2]) > STEEPEST:
            self._notices.warn(
                f"{self._topic}: by the IMU the camera looks straight up or down, so the bridge sends no gravity; check the frames of "
                "the IMU and of the images in TF, or pass --gravity mounting"
            )
            return None
        return down
