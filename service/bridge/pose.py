"""An answer as what ROS calls a pose with covariance: of the vehicle, in the map, about the vehicle's origin."""

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

Covariance = Float64[NDArray[np.float64], "6 6"]

#: A vehicle whose frame sits in the camera: x along the optical axis, y left, z up. Without it a planner would read the heading
#: off the optical frame's x, which looks to the right.
CAMERA_AS_BODY: Transform = transform_from(R_BODY_OPTICAL, np.zeros(3))
#: Where the service knows no covariance (``options.refine`` false): retrieval's, several metres and all headings' tenth, roughly.
_UNKNOWN: Covariance = np.diag([9.0, 9.0, 1.0, 0.01, 0.01, 0.1])


@dataclass(frozen=True, slots=True, eq=False)
class StampedPose:
    """What is published.

    Attributes:
        stamp_ns: of the colour picture.
        frame_id: of the map.
        T_map_vehicle: metres.
        covariance: x, y, z (m), rotations about the map's axes x, y, z (rad), about the vehicle's origin.
    """

    stamp_ns: int
    frame_id: str
    T_map_vehicle: Transform
    covariance: Covariance

    @property
    def quaternion_xyzw(self) -> Float64[NDArray[np.float64], "4"]:
        """Of the vehicle's axes in the map."""
        return quaternion_xyzw_from(self.T_map_vehicle[:3, :3])


def pose_of(answer: LocalizeAnswer, T_vehicle_camera: Transform, *, stamp_ns: int, frame_id: str) -> StampedPose:
    """The vehicle's pose.

    Args:
        answer: of the service; ``pose`` is the camera's, its covariance about the camera.
        T_vehicle_camera: where the camera sits; ``CAMERA_AS_BODY`` where the vehicle is the camera.
        stamp_ns: of the picture.
        frame_id: of the map.

    Raises:
        NotLocalizedError: the answer has no pose.
    """
    posed = answer.require_pose()
    p, q = posed.position, posed.orientation
    rotation = rotation_from_quaternion_xyzw(np.array([q.x, q.y, q.z, q.w]))
    T_map_camera = transform_from(rotation, np.array([p.x, p.y, p.z]))
    told = posed.covariance
    covariance = _UNKNOWN if told is None else np.array(told, np.float64).reshape(6, 6)
    T_map_vehicle = T_map_camera @ inverse(T_vehicle_camera)
    moved = about(covariance, T_map_vehicle[:3, 3] - T_map_camera[:3, 3])
    return StampedPose(stamp_ns, frame_id, T_map_vehicle, moved)


def about(covariance: Covariance, lever_m: Float64[NDArray[np.float64], "3"]) -> Covariance:
    """The same pose's covariance about another point of the same body.

    A small turn w about the first point moves the second by w x lever, so its error is dp - [lever]x w.

    Args:
        covariance: translation first, then rotation, map axes, about the first point.
        lever_m: from the first to the second point, map axes.
    """
    x, y, z = lever_m
    J = np.eye(6)
    J[:3, 3:] = -np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    moved: Covariance = J @ covariance @ J.T
    return 0.5 * (moved + moved.T)


def mount_from(text: str) -> Transform:
    """T_vehicle_camera as ``tf2_echo base_link camera_optical_frame`` prints it: X,Y,Z,QX,QY,QZ,QW.

    Raises:
        RequestError: it is no transform.
    """
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != 7 or not all(map(math.isfinite, numbers)) or abs(math.hypot(*numbers[3:]) - 1) > 0.01:
        raise RequestError(
            f"--mount: {text!r} is not X,Y,Z,QX,QY,QZ,QW (metres, unit quaternion), such as 0.2,0,0.5,-0.5,0.5,-0.5,0.5",
            field="mount",
        )
    return transform_from(rotation_from_quaternion_xyzw(np.array(numbers[3:])), np.array(numbers[:3]))
