"""Where the camera sits on the vehicle: as given, or from TF."""

from dataclasses import dataclass, field

from service.bridge.frames import StaticFrames
from service.bridge.gravity import STEEPEST
from service.bridge.notices import Notices
from service.bridge.pose import CAMERA_AS_BODY
from service.geometry.rigid import Transform
from service.imaging.level import GivenHeight
from service.option_limits import LEAST_HEIGHT_M, MOST_HEIGHT_M, VEHICLE_HEIGHT_STD_M

#: Longest wait for the mounting in TF, seconds, from the first colour image. A static transform comes right after the subscription.
TF_WAIT_S = 5.0
#: What ``Mounting.vehicle`` says if the pose is that of the camera, or of the frame of ``--mount``.
CAMERA, MOUNT = "camera", "mount"


def is_optical(T_vehicle_camera: Transform) -> bool:
    """Return whether a camera frame can be an optical frame: its z axis does not point up in the vehicle.

    Args:
        T_vehicle_camera: from the camera frame to a frame whose z axis points up.
    """
    return bool(T_vehicle_camera[2, 2] <= STEEPEST)


@dataclass(frozen=True, slots=True, eq=False)
class Mounting:
    """Pose and height of the camera.

    Attributes:
        T_vehicle_camera: from the camera frame to the vehicle frame, metres.
        vehicle: what the published pose is the pose of: a frame of TF, ``MOUNT``, or ``CAMERA``.
        camera_height: height of the camera above the ground; None: it is found in the depth image.
        T_upright_camera: from the camera frame to a frame of the vehicle whose z axis points up, metres; None if it is unknown.
    """

    T_vehicle_camera: Transform = field(default_factory=CAMERA_AS_BODY.copy)
    vehicle: str = CAMERA
    camera_height: GivenHeight | None = None
    T_upright_camera: Transform | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MountingRule:
    """How to find the mounting.

    Attributes:
        mount: ``T_vehicle_camera`` as given, metres; None: TF has it.
        base_frame: frame of the vehicle in TF; empty: the vehicle is the camera. ``mount`` goes before it.
        ground_frame: frame in TF whose origin lies on the ground under the vehicle and whose z axis points up; empty: there is none.
        camera_height: height as given; it goes before that of ``ground_frame``.
        height_std_m: standard deviation of the height over ``ground_frame``, metres.
    """

    mount: Transform | None = None
    base_frame: str = ""
    ground_frame: str = ""
    camera_height: GivenHeight | None = None
    height_std_m: float = VEHICLE_HEIGHT_STD_M

    def is_complete(self, frames: StaticFrames, camera_frame: str) -> bool:
        """Return whether the pose of the vehicle can be published.

        Args:
            frames: of the robot.
            camera_frame: frame of the colour image.
        """
        known = self.mount is not None or not self.base_frame
        return known or frames.transform(self.base_frame, camera_frame) is not None

    def mounting(self, frames: StaticFrames, camera_frame: str, notices: Notices) -> Mounting:
        """Return the mounting as far as it is known.

        Args:
            frames: of the robot.
            camera_frame: frame of the colour image.
            notices: takes warnings.
        """
        T_ground_camera = frames.transform(self.ground_frame, camera_frame) if self.ground_frame else None
        T_base_camera = self.mount
        if T_base_camera is None and self.base_frame:
            T_base_camera = self._in_tf(frames, camera_frame, notices)
        height = self.camera_height or self._height(T_ground_camera, notices)
        # The frame on the ground comes first: its z axis is perpendicular to the ground.
        T_upright_camera = T_base_camera
        if T_ground_camera is not None and is_optical(T_ground_camera):
            T_upright_camera = T_ground_camera
        if T_base_camera is None:
            return Mounting(camera_height=height, T_upright_camera=T_upright_camera)
        vehicle = self.base_frame if self.mount is None else MOUNT
        return Mounting(T_base_camera, vehicle, height, T_upright_camera)

    def _in_tf(self, frames: StaticFrames, camera_frame: str, notices: Notices) -> Transform | None:
        T = frames.transform(self.base_frame, camera_frame)
        if T is None:
            notices.warn(
                f"--base-frame: /tf_static does not connect {camera_frame!r}, the frame of the colour image, with {self.base_frame!r}, so "
                "the published pose is that of the camera; publish the transform, name another --base-frame, or give --mount"
            )
            return None
        if not is_optical(T):
            notices.warn(
                f"--base-frame: the z axis of {camera_frame!r}, the frame of the colour image, points up in {self.base_frame!r}, so it "
                "is no optical frame, and the published pose is that of the camera; let the driver name the optical frame, or give "
                "--mount"
            )
            return None
        return T

    def _height(self, T_ground_camera: Transform | None, notices: Notices) -> GivenHeight | None:
        if T_ground_camera is None:
            return None
        height_m = float(T_ground_camera[2, 3])
        if not LEAST_HEIGHT_M <= height_m <= MOST_HEIGHT_M:
            notices.warn(
                f"--ground-frame: the camera is {height_m:g} m above {self.ground_frame!r} in TF, outside {LEAST_HEIGHT_M:g} to "
                f"{MOST_HEIGHT_M:g} m, so the service finds the height in the depth image; correct TF, name another --ground-frame, or "
                "give --camera-height-m"
            )
            return None
        return GivenHeight(height_m, self.height_std_m)
