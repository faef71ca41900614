"""Poses over time, with interpolation between them."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from service.errors import DatasetError

Sync = Literal["interpolate", "nearest"]
#: Tolerance of times, seconds. A double that counts seconds since 1970 has a resolution of a quarter of a microsecond.
_SLACK_S = 1e-6
Transforms = Float64[NDArray[np.float64], "N 4 4"]


@dataclass(frozen=True)
class Trajectory:
    """T_map_vehicle at rising times.

    Attributes:
        stamps_s: times (N,), seconds, rising.
        T_map_vehicle: poses (N, 4, 4).
        name: name of the file or topic, for errors.

    Raises:
        DatasetError: there are no poses, one is not finite, or the times do not rise; the error names the first such pose.
    """

    stamps_s: Float64[NDArray[np.float64], " N"]
    T_map_vehicle: Transforms
    name: str

    def __post_init__(self) -> None:
        """Check the poses.

        Raises:
            DatasetError: there are no poses, one is not finite, or the times do not rise.
        """
        if not len(self.stamps_s):
            raise DatasetError(f"{self.name}: the file has no pose; give another source of poses", field="poses")
        finite = np.isfinite(self.stamps_s) & np.isfinite(self.T_map_vehicle).all(axis=(1, 2))
        if not finite.all():
            raise DatasetError(
                f"{self.name}, pose {int(np.argmin(finite)) + 1}: a value is not finite; remove the pose",
                field="poses",
            )
        late = np.flatnonzero(np.diff(self.stamps_s) <= 0)
        if len(late):
            k = int(late[0]) + 1
            raise DatasetError(
                f"{self.name}, pose {k + 1}: its time {self.stamps_s[k]:.6f} s is not after the "
                f"{self.stamps_s[k - 1]:.6f} s before it; sort the poses by time and remove duplicates",
                field="poses",
            )

    def at(self, stamp_s: float, *, sync: Sync, tolerance_s: float) -> Float64[NDArray[np.float64], "4 4"] | str:
        """Return the pose at a time, or the reason why there is none.

        Args:
            stamp_s: the time, seconds.
            sync: ``interpolate`` between the poses before and after (position linearly, rotation by slerp), never beyond the
                first and last pose; ``nearest`` takes one pose. A trajectory of one pose always uses ``nearest``.
            tolerance_s: greatest time between the used poses and ``stamp_s``, seconds.

        Returns:
            T_map_vehicle (4, 4), or the reason.
        """
        after = int(np.searchsorted(self.stamps_s, stamp_s))
        around = [k for k in (after - 1, after) if 0 <= k < len(self.stamps_s)]
        away = np.abs(self.stamps_s[around] - stamp_s)
        if away.min() <= _SLACK_S or sync == "nearest" or len(self.stamps_s) == 1:
            if away.min() > tolerance_s + _SLACK_S:
                return f"no pose within {tolerance_s:g} s"
            return np.asarray(self.T_map_vehicle[around[int(np.argmin(away))]])
        if len(around) == 1:
            return "before the first pose" if after == 0 else "after the last pose"
        if away.max() > tolerance_s + _SLACK_S:
            return f"no poses within {tolerance_s:g} s before and after"
        return np.asarray(self.between(np.array([stamp_s]))[0])

    def between(self, stamps_s: Float64[NDArray[np.float64], " M"]) -> Float64[NDArray[np.float64], "M 4 4"]:
        """Interpolate the poses. Before the first and after the last time, the first and the last pose apply.

        Args:
            stamps_s: times, seconds.

        Returns:
            T_map_vehicle (M, 4, 4).
        """
        inside = np.clip(stamps_s, self.stamps_s[0], self.stamps_s[-1])
        T = np.tile(np.eye(4), (len(inside), 1, 1))
        if len(self.stamps_s) == 1:
            T[:] = self.T_map_vehicle[0]
            return T
        first = np.clip(np.searchsorted(self.stamps_s, inside, side="right") - 1, 0, len(self.stamps_s) - 2)
        low, high = int(first.min()), int(first.max()) + 2  # build the slerp only over the poses that are needed
        window = self.stamps_s[low:high]
        rotations = Rotation.from_matrix(self.T_map_vehicle[low:high, :3, :3])
        T[:, :3, :3] = Slerp(window, rotations)(inside).as_matrix()
        for axis in range(3):
            T[:, axis, 3] = np.interp(inside, window, self.T_map_vehicle[low:high, axis, 3])
        return T

    def moved_by(self, T_vehicle_sensor: Float64[NDArray[np.float64], "4 4"]) -> "Trajectory":
        """Convert the trajectory of a sensor on the vehicle to that of the vehicle.

        Args:
            T_vehicle_sensor: mounting of the sensor whose poses these are (4, 4).
        """
        R, t = T_vehicle_sensor[:3, :3], T_vehicle_sensor[:3, 3]
        T_sensor_vehicle = np.eye(4)
        T_sensor_vehicle[:3, :3], T_sensor_vehicle[:3, 3] = R.T, -R.T @ t
        return Trajectory(self.stamps_s, self.T_map_vehicle @ T_sensor_vehicle, self.name)
