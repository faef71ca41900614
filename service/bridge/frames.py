"""Fixed transforms between the frames of a robot, as ``/tf_static`` has them."""

import math
from typing import Any

import numpy as np

from service.geometry.rigid import Transform, inverse, rotation_from_quaternion_xyzw, transform_from


class StaticFrames:
    """Tree of frames. Only fixed transforms count, so a camera on a moving joint has no transform to the vehicle."""

    def __init__(self) -> None:
        self._above: dict[str, tuple[str, Transform]] = {}

    def add(self, message: Any) -> None:
        """Add transforms. A later transform of the same frame replaces the earlier one.

        A transform that ``rigid_from`` refuses is left out, so its frames stay unconnected.

        Args:
            message: tf2_msgs/TFMessage.
        """
        for each in message.transforms:
            T_parent_child = rigid_from(each.transform.translation, each.transform.rotation)
            if T_parent_child is not None:
                self._above[plain(each.child_frame_id)] = (plain(each.header.frame_id), T_parent_child)

    def transform(self, target: str, source: str) -> Transform | None:
        """Return ``T_target_source``, metres; None if the tree does not connect the frames.

        Args:
            target: name of the frame that the transform leads to.
            source: name of the frame that it starts from.
        """
        target_root, T_root_target = self._from_root(plain(target))
        source_root, T_root_source = self._from_root(plain(source))
        return inverse(T_root_target) @ T_root_source if target_root == source_root else None

    def _from_root(self, frame: str) -> tuple[str, Transform]:
        """Return the root above a frame, and the transform from the frame to the root. A loop ends where it began."""
        T, passed = np.eye(4), {frame}
        while frame in self._above:
            frame, T_above = self._above[frame]
            T = T_above @ T
            if frame in passed:
                break
            passed.add(frame)
        return frame, T


def rigid_from(position: Any, orientation: Any) -> Transform | None:
    """Return a rigid transform, translation in metres; None if a number is not finite, or if the quaternion is no rotation.

    Args:
        position: geometry_msgs/Vector3 or Point.
        orientation: geometry_msgs/Quaternion. Its length must be at least 0.5: some publishers send zeros for an unknown rotation.
    """
    quaternion = np.array([orientation.x, orientation.y, orientation.z, orientation.w], np.float64)
    at = np.array([position.x, position.y, position.z], np.float64)
    if not (0.5 <= math.hypot(*quaternion) < math.inf and np.isfinite(at).all()):
        return None
    return transform_from(rotation_from_quaternion_xyzw(quaternion), at)


def plain(frame: str) -> str:
    """Return the name of a frame without the leading slash of ROS 1.

    Args:
        frame: name as in a message.
    """
    return frame.removeprefix("/")
