"""The last poses of a stream with their time stamps, interpolated between the stamps."""

from bisect import bisect_left

from service.geometry.rigid import (
    Transform,
    quaternion_xyzw_from,
    rotation_from_quaternion_xyzw,
    transform_from,
)

#: A stamp that lies so far before the newest one belongs to another clock, seconds: a simulation or a recording began again.
_RESTART_S = 1.0


class PoseHistory:
    """Poses by time stamp.

    Args:
        most: maximum number of poses. The oldest ones are dropped.
        gap_s: longest time between two poses that is interpolated, seconds.

    Attributes:
        session: number of restarts. Poses of two sessions are not related.
    """

    def __init__(self, *, most: int = 3000, gap_s: float = 0.5) -> None:
        self._most, self._gap_ns = most, round(1e9 * gap_s)
        self._stamps_ns: list[int] = []
        self._poses: list[Transform] = []
        self.session = 0

    @property
    def newest_ns(self) -> int | None:
        """Stamp of the newest pose, ns; None without a pose."""
        return self._stamps_ns[-1] if self._stamps_ns else None

    def add(self, stamp_ns: int, T: Transform) -> None:
        """Add a pose. A pose that is not newer than the last one is dropped, unless its stamp shows a restart.

        Args:
            stamp_ns: of the pose, ns.
            T: the pose, (4, 4), metres.
        """
        newest_ns = self.newest_ns
        if newest_ns is not None and stamp_ns < newest_ns - 1e9 * _RESTART_S:
            self.restart()
        elif newest_ns is not None and stamp_ns <= newest_ns:
            return
        self._stamps_ns.append(stamp_ns)
        self._poses.append(T)
        if len(self._poses) > self._most:
            del self._stamps_ns[: -self._most], self._poses[: -self._most]

    def restart(self) -> None:
        """Drop all poses and begin a new session."""
        self._stamps_ns.clear()
        self._poses.clear()
        self.session += 1

    def newest(self) -> Transform | None:
        """Return the newest pose; None without a pose."""
        return self._poses[-1] if self._poses else None

    def at(self, stamp_ns: int, *, hold_s: float = 0.0) -> Transform | None:
        """Return the pose at a time; None if it is unknown.

        Args:
            stamp_ns: the time, ns.
            hold_s: time beyond the first and the last pose for which these poses still hold, seconds.
        """
        if not self._stamps_ns:
            return None
        after = bisect_left(self._stamps_ns, stamp_ns)
        if after == len(self._stamps_ns) or (after == 0 and self._stamps_ns[0] != stamp_ns):
            nearest = min(after, len(self._stamps_ns) - 1)
            near = abs(self._stamps_ns[nearest] - stamp_ns) <= 1e9 * hold_s
            return self._poses[nearest] if near else None
        if self._stamps_ns[after] == stamp_ns:
            return self._poses[after]
        first_ns, last_ns = self._stamps_ns[after - 1], self._stamps_ns[after]
        if last_ns - first_ns > self._gap_ns:
            return None
        return between(self._poses[after - 1], self._poses[after], (stamp_ns - first_ns) / (last_ns - first_ns))


def between(T_first: Transform, T_last: Transform, share: float) -> Transform:
    """Interpolate two poses: position linearly, rotation by the normalised linear mean of the quaternions.

    For rotations of up to 30 degrees this mean differs from the exact one (slerp) by less than 0.05 degrees.

    Args:
        T_first: pose at share 0.
        T_last: pose at share 1.
        share: 0 to 1.
    """
    first, last = quaternion_xyzw_from(T_first[:3, :3]), quaternion_xyzw_from(T_last[:3, :3])
    if first @ last < 0:  # q and -q are the same rotation; take the nearer one
        last = -last
    rotation = rotation_from_quaternion_xyzw((1.0 - share) * first + share * last)
    return transform_from(rotation, (1.0 - share) * T_first[:3, 3] + share * T_last[:3, 3])
