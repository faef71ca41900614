"""What other topics than the images say about the robot, and what the settings say."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from service.bridge.frames import StaticFrames
from service.bridge.gravity import Imu, down_on_vehicle
from service.bridge.initial_pose import InitialPoses
from service.bridge.known import Known, Motion
from service.bridge.mounting import CAMERA, MOUNT, TF_WAIT_S, Mounting, MountingRule, is_optical
from service.bridge.notices import Notices
from service.bridge.odometry import Odometry, OdometryPose
from service.bridge.pose import StampedPose
from service.bridge.rig import StereoRig
from service.bridge.settings import GravitySource
from service.geometry.rigid import Transform, inverse
from service.localization.belief import std_of_motion

#: Longest motion between two queries of a track, metres. A longer one is a jump of the odometry, for example to the coordinates of GNSS.
MOST_MOTION_M = 1000.0


@dataclass(frozen=True, slots=True, eq=False)
class Facts:
    """What is known at the time of an image pair.

    Attributes:
        known: goes into the query.
        mounting: of the camera.
        values: names and texts for the diagnostics.
        camera: pose of the camera by odometry; None if it is unknown.
        priors: number of received poses that became a prior.
    """

    known: Known
    mounting: Mounting
    values: tuple[tuple[str, str], ...]
    camera: OdometryPose | None
    priors: int


@dataclass(slots=True, kw_only=True)
class Robot:
    """Collects facts that go into queries beside the images.

    Attributes:
        rig: stereo rig that measures the depth.
        rule: how to find the mounting of the camera.
        gravity: where the direction of gravity comes from; ``imu`` needs one.
        odometry: of the robot; None: no queries are connected to tracks.
        odometry_noise: standard deviation of the odometry as a share of the distance and of the angle; None for the usual one.
        imu: orientation of an IMU; None if there is none.
        initial_poses: poses that become the prior; None if there are none.
        frames: fixed transforms of TF.
        notices: warnings for the operator.
    """

    rig: StereoRig = field(default_factory=StereoRig)
    rule: MountingRule = field(default_factory=MountingRule)
    gravity: GravitySource = "none"
    odometry: Odometry | None = None
    odometry_noise: float | None = None
    imu: Imu | None = None
    initial_poses: InitialPoses | None = None
    frames: StaticFrames = field(default_factory=StaticFrames)
    notices: Notices = field(default_factory=Notices)
    _seen_since_s: float | None = None
    _last: Facts | None = None

    def handlers(self, clock: Callable[[], float]) -> dict[str, Callable[[Any], None]]:
        """Return the functions that take messages, by the attribute of ``Topics`` that names their topic.

        Args:
            clock: monotonic time, s.
        """
        found: dict[str, Callable[[Any], None]] = {"right_info": self.rig.info, "tf_static": self.frames.add}
        odometry, poses = self.odometry, self.initial_poses
        if odometry is not None:
            found["odom"] = odometry.add
        if self.imu is not None:
            found["imu"] = self.imu.add
        if poses is not None:
            found["prior"] = lambda message: poses.add(
                message, clock(), None if odometry is None else odometry.newest()
            )
        return found

    def missing(self) -> tuple[str, ...]:
        """Return the topics (attributes of ``Topics``) without which no query can be sent, and that brought nothing yet."""
        return ("right_info",) if self.rig.is_missing else ()

    def waits_for_tf(self, camera_frame: str, now_s: float) -> bool:
        """Return whether the mounting is unknown, and TF may still bring it.

        Args:
            camera_frame: frame of the colour image.
            now_s: current time of a monotonic clock, s.
        """
        if self._seen_since_s is None:
            self._seen_since_s = now_s
        return now_s - self._seen_since_s < TF_WAIT_S and not self.rule.is_complete(self.frames, camera_frame)

    def is_ready(self, stamp_ns: int) -> bool:
        """Return whether the odometry of an image is there, or does not come.

        Args:
            stamp_ns: of the image, ns.
        """
        return self.odometry is None or self.odometry.is_ready(stamp_ns)

    def stop_waiting(self) -> None:
        """Send queries without odometry until its next message."""
        if self.odometry is not None:
            self.odometry.stop_waiting()

    def facts(self, stamp_ns: int, camera_frame: str, now_s: float) -> Facts:
        """Return the facts for a query.

        Args:
            stamp_ns: of the colour image, ns.
            camera_frame: frame of the colour image.
            now_s: current time of a monotonic clock, s.

        Raises:
            RequestError: a topic brought a message that cannot be used.
        """
        mounting = self.rule.mounting(self.frames, camera_frame, self.notices)
        body = None if self.odometry is None else self.odometry.at(stamp_ns)
        T_body_camera = None if body is None else self._body_camera(camera_frame, mounting)
        camera = None
        if body is not None and T_body_camera is not None:
            camera = OdometryPose(body.T_odom @ T_body_camera, body.session)
        poses = self.initial_poses
        prior = None if poses is None else poses.prior(mounting.T_vehicle_camera, body, T_body_camera, now_s)
        down = None
        if self.gravity == "mounting":
            down = down_on_vehicle(mounting.T_upright_camera, self.notices)
        elif self.gravity == "imu" and self.imu is not None:
            down = self.imu.down(stamp_ns, camera_frame, self.frames)
        priors = 0 if poses is None else poses.count
        motion = self._motion(camera, priors)
        known = Known(
            baseline_m=self.rig.baseline_m(),
            camera_height=mounting.camera_height,
            down_camera=down,
            prior=None if prior is None else prior[0],
            motion=motion,
        )
        values = (
            ("pose_of", mounting.vehicle),
            ("gravity", "none" if down is None else self.gravity),
            ("prior", "none" if prior is None else f"{prior[1]:.1f} s old, {prior[0].position_std_m:.1f} m"),
            ("track", _about(motion)),
        )
        return Facts(known, mounting, values, camera, priors)

    def answered(self, facts: Facts) -> None:
        """Note that the service answered a query. The next motion begins there.

        Args:
            facts: of the query.
        """
        self._last = facts

    def published(self, pose: StampedPose) -> None:
        """Note that a pose was published. It replaces the prior.

        Args:
            pose: as published.
        """
        if self.initial_poses is not None:
            self.initial_poses.published(pose)

    def _motion(self, camera: OdometryPose | None, priors: int) -> Motion | None:
        """Return the motion since the last answered query; None without odometry."""
        if camera is None:
            return None
        last = self._last
        # The service reads a prior in the first query of a track only.
        if last is None or last.camera is None or last.camera.session != camera.session or last.priors != priors:
            return Motion()
        T_previous_camera = inverse(last.camera.T_odom) @ camera.T_odom
        if np.linalg.norm(T_previous_camera[:3, 3]) > MOST_MOTION_M:
            return Motion()
        share = self.odometry_noise
        return Motion(T_previous_camera, None if share is None else std_of_motion(T_previous_camera, share))

    def _body_camera(self, camera_frame: str, mounting: Mounting) -> Transform | None:
        """Return the transform from the camera frame to the body frame of the odometry; None if it is unknown."""
        body_frame = "" if self.odometry is None else self.odometry.body_frame
        T = self.frames.transform(body_frame, camera_frame) if body_frame else None
        if T is not None and is_optical(T):
            return T
        # An odometry without a frame name is that of the vehicle. So is any odometry, if only --mount says where the camera is.
        if mounting.vehicle == MOUNT or (not body_frame and mounting.vehicle != CAMERA):
            return mounting.T_vehicle_camera
        self.notices.warn(
            f"--odom-topic: /tf_static does not connect {camera_frame!r}, the frame of the colour image, with {body_frame!r}, the "
            "child_frame_id of the odometry, so the bridge does not use the odometry; publish the transform, or give --mount"
        )
        return None


def _about(motion: Motion | None) -> str:
    if motion is None:
        return "none"
    return "begins" if motion.T_previous_camera is None else "continues"
