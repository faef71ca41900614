"""The tree of frames from ``/tf`` and ``/tf_static``."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from model_training.importing.trajectory import Trajectory
from service.geometry.rigid import Transform, inverse, rotation_from_quaternion_xyzw, transform_from


def transform_of(message: Any) -> Transform | None:
    """Convert a geometry_msgs Transform (translation, rotation) or Pose (position, orientation) to a matrix (4, 4).

    Args:
        message: of ROS 1 or 2.

    Returns:
        The matrix. None if a number is not finite or the quaternion is zero; localisers send that before they have a pose.
    """
    at = message.translation if hasattr(message, "translation") else message.position
    turned = message.rotation if hasattr(message, "rotation") else message.orientation
    quaternion = np.array([turned.x, turned.y, turned.z, turned.w], np.float64)
    translation = np.array([at.x, at.y, at.z], np.float64)
    if not np.isfinite(translation).all() or not np.isfinite(quaternion).all() or np.linalg.norm(quaternion) < 1e-6:
        return None
    return transform_from(rotation_from_quaternion_xyzw(quaternion), translation)


def stamp_of(header: Any) -> float:
    """Return the time of a std_msgs Header, seconds.

    Args:
        header: of ROS 1 or 2.
    """
    stamp = header.stamp
    return float(stamp.sec) + 1e-9 * float(stamp.nanosec)


@dataclass(slots=True)
class FrameTree:
    """Edges from parent to child frames. An edge with several times moves."""

    _stamps: dict[str, list[float]] = field(default_factory=dict)
    _poses: dict[str, list[Transform]] = field(default_factory=dict)
    _parent: dict[str, str] = field(default_factory=dict)
    _static: set[str] = field(default_factory=set)

    def add(self, message: Any, *, static: bool) -> bool:
        """Add one TransformStamped.

        Args:
            message: geometry_msgs/TransformStamped.
            static: it comes from ``/tf_static``.

        Returns:
            False if it was left out: its numbers are invalid, or its time is not later than the edge's last time.
        """
        child, parent = _name(message.child_frame_id), _name(message.header.frame_id)
        stamp_s, T = 0.0 if static else stamp_of(message.header), transform_of(message.transform)
        if T is None:
            return False
        if static:
            self._static.add(child)
            self._stamps[child], self._poses[child] = [], []
        stamps = self._stamps.setdefault(child, [])
        if stamps and stamp_s <= stamps[-1]:
            return False
        self._parent[child] = parent
        stamps.append(stamp_s)
        self._poses.setdefault(child, []).append(T)
        return True

    def chain(self, frame: str) -> list[str]:
        """Return a frame and all frames above it, up to the root.

        Args:
            frame: name of the frame.
        """
        chain = [_name(frame)]
        while chain[-1] in self._parent and self._parent[chain[-1]] not in chain:
            chain.append(self._parent[chain[-1]])
        return chain

    def fixed(self, target: str, source: str) -> Transform | None:
        """Return T_target_source from edges that do not move; None if they do not connect the two frames.

        Args:
            target: name of the frame that points are mapped to.
            source: name of the frame that points are mapped from.
        """
        above_target, above_source = self.chain(target), self.chain(source)
        shared = next((name for name in above_source if name in above_target), None)
        if shared is None:
            return None
        edges = above_source[: above_source.index(shared)] + above_target[: above_target.index(shared)]
        if not all(name in self._static or len(self._stamps[name]) == 1 for name in edges):
            return None
        return inverse(self._down(shared, above_target)) @ self._down(shared, above_source)

    def moving(self, source: str, *, name: str) -> tuple[str, Trajectory] | None:
        """Return the root above a frame and T_root_source over time; None if no edge moves.

        The times are those of the edge with the most times.

        Args:
            source: name of the frame.
            name: name of the trajectory, for messages.
        """
        chain = self.chain(source)
        edges = [edge for edge in chain[:-1] if edge not in self._static and len(self._stamps[edge]) > 1]
        if not edges:
            return None
        stamps = np.array(self._stamps[max(edges, key=lambda edge: len(self._stamps[edge]))])
        begin, end = max(self._stamps[edge][0] for edge in edges), min(self._stamps[edge][-1] for edge in edges)
        stamps = stamps[(stamps >= begin) & (stamps <= end)]
        T = np.tile(np.eye(4), (len(stamps), 1, 1))
        for edge in chain[:-1]:
            poses = np.stack(self._poses[edge])
            T = (
                Trajectory(np.array(self._stamps[edge]), poses, edge).between(stamps) if edge in edges else poses[0]
            ) @ T
        return chain[-1], Trajectory(stamps, T, name)

    def lowest_that_moves(self) -> str | None:
        """Return the moving frame with the most edges above it, such as base_link below map and odom; None if none moves."""
        moving = [name for name in self._stamps if name not in self._static and len(self._stamps[name]) > 1]
        return max(moving, key=lambda name: len(self.chain(name)), default=None)

    def _down(self, top: str, chain: list[str]) -> Transform:
        T = np.eye(4)
        for edge in chain[: chain.index(top)]:
            T = self._poses[edge][0] @ T
        return T


def _name(frame: str) -> str:
    """Remove the leading slash that some ROS 1 names have."""
    return frame.lstrip("/")
