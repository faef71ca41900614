"""Convert an answer to a ROS pose with covariance: pose of the vehicle in the map frame, covariance about the vehicle origin."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from service.contract.schema import LocalizeAnswer
from service.errors import RequestError
from service.geometry.rigid import (
    R_BODY_OPTICAL,
    Transform,
    inverse,
    quaternion_xyzw_from,
    rotation_from_quaternion_xyzw,
    transform_from,
)
from service.imaging.level import GivenHeight
from service.option_limits import HEIGHT_STD_M, LEAST_HEIGHT_M, MOST_HEIGHT_M

Covariance = Float64[NDArray[np.float64], "6 6"]

#: Vehicle frame at the camera: x along the optical axis, y left, z up. Without it a planner would take the x axis of the optical
#: frame as heading, which points right.
CAMERA_AS_BODY: Transform = transform_from(R_BODY_OPTICAL, np.zeros(3))
#: Covariance if the answer has none (``options.refine`` false), for the accuracy of retrieval: standard deviations of 3 m in x and y,
#: 1 m in z, 0.1 rad about x and y, 0.32 rad about z.
_UNKNOWN: Covariance = np.diag([9.0, 9.0, 1.0, 0.01, 0.01, 0.1])


@dataclass(frozen=True, slots=True, eq=False)
class StampedPose:
    """A pose to publish.

    Attributes:
        stamp_ns: of the RGB image, ns.
        frame_id: of the map.
        T_map_vehicle: from the vehicle frame to the map frame, metres.
        covariance: of x, y, z (m) and the rotations about the map axes x, y, z (rad), at the vehicle origin.
    """

    stamp_ns: int
    frame_id: str
    T_map_vehicle: Transform
    covariance: Covariance

    @property
    def quaternion_xyzw(self) -> Float64[NDArray[np.float64], "4"]:
        """Orientation of the vehicle in the map frame, as x, y, z, w."""
        return quaternion_xyzw_from(self.T_map_vehicle[:3, :3])


def pose_of(answer: LocalizeAnswer, T_vehicle_camera: Transform, *, stamp_ns: int, frame_id: str) -> StampedPose:
    """Compute the pose of the vehicle from an answer.

    Args:
        answer: of the service; its pose and covariance are those of the camera.
        T_vehicle_camera: from the camera frame to the vehicle frame, metres; ``CAMERA_AS_BODY`` if the vehicle is the camera.
        stamp_ns: of the RGB image, ns.
        frame_id: of the map.

    Raises:
        NotLocalizedError: the answer has no pose.
    """
    posed = answer.require_pose()
    p, q = posed.position, posed.orientation
    rotation = rotation_from_quaternion_xyzw(np.array([q.x, q.y, q.z, q.w]))
    T_map_camera = transform_from(rotation, np.array([p.x, p.y, p.z]))
    given = posed.covariance
    covariance = _UNKNOWN if given is None else np.array(given, np.float64).reshape(6, 6)
    T_map_vehicle = T_map_camera @ inverse(T_vehicle_camera)
    moved = about(covariance, T_map_vehicle[:3, 3] - T_map_camera[:3, 3])
    return StampedPose(stamp_ns, frame_id, T_map_vehicle, moved)


def about(covariance: Covariance, lever_m: Float64[NDArray[np.float64], "3"]) -> Covariance:
    """Transform a pose covariance to another reference point of the same rigid body.

    A small rotation w about the first point moves the second by w x lever, so its error is dp - [lever]x w.

    Args:
        covariance: at the first point: translation (m), then rotation (rad), map axes.
        lever_m: from the first to the second point, map axes, metres.
    """
    x, y, z = lever_m
    J = np.eye(6)
    J[:3, 3:] = -np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    moved: Covariance = J @ covariance @ J.T
    return 0.5 * (moved + moved.T)


def mount_from(text: str) -> Transform:
    """Parse T_vehicle_camera as ``tf2_echo base_link camera_optical_frame`` prints it.

    Args:
        text: X,Y,Z,QX,QY,QZ,QW; metres and a unit quaternion.

    Raises:
        RequestError: the text is no transform.
    """
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != 7 or not all(map(math.isfinite, numbers)) or abs(math.hypot(*numbers[3:]) - 1) > 0.01:
        raise RequestError(
            f"--mount: {text!r} is invalid; give X,Y,Z,QX,QY,QZ,QW (metres, unit quaternion), such as 0.2,0,0.5,-0.5,0.5,-0.5,0.5",
            field="mount",
        )
    return transform_from(rotation_from_quaternion_xyzw(np.array(numbers[3:])), np.array(numbers[:3]))


def measured_height(camera_height_m: float, std_m: float = 0.0) -> GivenHeight | None:
    """Return the height of the camera above the ground as somebody measured it; None if nobody did.

    Args:
        camera_height_m: height, metres; 0 if it was not measured.
        std_m: its standard deviation, metres; 0 for the usual one.

    Raises:
        RequestError: the height is out of bounds.
    """
    if not camera_height_m:
        return None
    if not LEAST_HEIGHT_M <= camera_height_m <= MOST_HEIGHT_M:
        raise RequestError(
            f"--camera-height-m: {camera_height_m:g} m is not a valid camera height; give {LEAST_HEIGHT_M:g} to {MOST_HEIGHT_M:g} m, "
            "or 0 to take it from TF or the depth image",
            field="camera_height_m",
        )
    return GivenHeight(camera_height_m, std_m or HEIGHT_STD_M)


def height_on_mount(mount: Transform, std_m: float) -> GivenHeight:
    """Return the height of the camera above the origin of its mounting, which lies on the ground.

    Args:
        mount: from the camera frame to the vehicle frame (z up), metres.
        std_m: standard deviation of the height, metres.

    Raises:
        RequestError: the height is out of bounds.
    """
    height_m = float(mount[2, 3])
    if not LEAST_HEIGHT_M <= height_m <= MOST_HEIGHT_M:
        raise RequestError(
            f"--mount: with --base-on-ground, its Z of {height_m:g} m is the camera height, which must be {LEAST_HEIGHT_M:g} to "
            f"{MOST_HEIGHT_M:g} m; give the mounting on base_footprint, or --camera-height-m without --base-on-ground",
            field="mount",
        )
    return GivenHeight(height_m, std_m)
