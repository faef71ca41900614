"""Poses over time, asked at any moment between them."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from service.errors import DatasetError

Sync = Literal["interpolate", "nearest"]
#: Times are doubles since 1970, which are whole steps of a quarter of a microsecond.
_SLACK_S = 1e-6
Transforms = Float64[NDArray[np.float64], "N 4 4"]


@dataclass(frozen=True)
class Trajectory:
    """T_map_vehicle at rising times.

    Attributes:
        stamps_s: (n,) seconds, each later than the one before.
        T_map_vehicle: (n, 4, 4).
        name: the file or topic, for messages.

    Raises:
        DatasetError: there are no poses, one is no numbers, or time does not rise, naming the first such pose.
    """

    stamps_s: Float64[NDArray[np.float64], " N"]
    T_map_vehicle: Transforms
    name: str

    def __post_init__(self) -> None:
        """Refuse what cannot be asked."""
        if not len(self.stamps_s):
            raise DatasetError(f"{self.name}: there is no pose in it; name another source of poses", field="poses")
        finite = np.isfinite(self.stamps_s) & np.isfinite(self.T_map_vehicle).all(axis=(1, 2))
        if not finite.all():
            raise DatasetError(
                f"{self.name}, pose {int(np.argmin(finite)) + 1}: a number in it is not finite; leave it out",
                field="poses",
            )
        late = np.flatnonzero(np.diff(self.stamps_s) <= 0)
        if len(late):
            k = int(late[0]) + 1
            raise DatasetError(
                f"{self.name}, pose {k + 1}: its time {self.stamps_s[k]:.6f} s is not after the {self.stamps_s[k - 1]:.6f} s before it; "
                "sort the poses by time and drop doubled ones",
                field="poses",
            )

    def at(self, stamp_s: float, *, sync: Sync, tolerance_s: float) -> Float64[NDArray[np.float64], "4 4"] | str:
        """The pose at a moment, or why there is none.

        Args:
            stamp_s: the moment.
            sync: ``interpolate`` between the poses before and after (position linearly, rotation by slerp), and never beyond the
                first and last; ``nearest`` takes one, as is done with a single pose.
            tolerance_s: how far the poses that are used may be from the moment.
        """
        after = int(np.searchsorted(self.stamps_s, stamp_s))
        around = [k for k in (after - 1, after) if 0 <= k < len(self.stamps_s)]
        away = np.abs(self.stamps_s[around] - stamp_s)
        if away.min() <= _SLACK_S or sync == "nearest" or len(self.stamps_s) == 1:
            if away.min() > tolerance_s + _SLACK_S:
                return f"no pose within {tolerance_s:g} s"
            return np.asarray(self.T_map_vehicle[around[int(np.argmin(away))]])
        if len(around) == 1:
            return "it lies before the first pose" if after == 0 else "it lies after the last pose"
        if away.max() > tolerance_s + _SLACK_S:
            return f"no poses within {tolerance_s:g} s before and after"
        return np.asarray(self.between(np.array([stamp_s]))[0])

    def between(self, stamps_s: Float64[NDArray[np.float64], " M"]) -> Float64[NDArray[np.float64], "M 4 4"]:
        """Interpolated poses; before the first and after the last pose it is that one."""
        inside = np.clip(stamps_s, self.stamps_s[0], self.stamps_s[-1])
        T = np.tile(np.eye(4), (len(inside), 1, 1))
        if len(self.stamps_s) == 1:
            T[:] = self.T_map_vehicle[0]
            return T
        first = np.clip(np.searchsorted(self.stamps_s, inside, side="right") - 1, 0, len(self.stamps_s) - 2)
        low, high = int(first.min()), int(first.max()) + 2  # a slerp over the poses around, not over the whole drive
        window = self.stamps_s[low:high]
        rotations = Rotation.from_matrix(self.T_map_vehicle[low:high, :3, :3])
        T[:, :3, :3] = Slerp(window, rotations)(inside).as_matrix()
        for axis in range(3):
            T[:, axis, 3] = np.interp(inside, window, self.T_map_vehicle[low:high, axis, 3])
        return T

    def moved_by(self, T_vehicle_sensor: Float64[NDArray[np.float64], "4 4"]) -> "Trajectory":
        """The trajectory of ``vehicle`` from one of a sensor on it: these poses are T_map_sensor."""
        R, t = T_vehicle_sensor[:3, :3], T_vehicle_sensor[:3, 3]
        T_sensor_vehicle = np.eye(4)
        T_sensor_vehicle[:3, :3], T_sensor_vehicle[:3, 3] = R.T, -R.T @ t
        return Trajectory(self.stamps_s, self.T_map_vehicle @ T_sensor_vehicle, self.name)
