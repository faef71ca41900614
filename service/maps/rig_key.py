"""What tells one camera rig from another: the camera and its depth sensor, as far as a request states them."""

import math
from collections.abc import Collection
from typing import ClassVar

from pydantic import BaseModel, ConfigDict, Field

from service.geometry.camera import PinholeCamera

#: Largest difference of the focal length as a share of the image side, relative to the larger one. Two calibrations of one lens differ by
#: 1 to 2 %. The principal point may differ by as much of the image side.
FIELD = 0.05
#: Largest difference of the image sides, relative to the larger one. The noise of stereo depth changes with the size of a pixel.
SIZE = 0.1
#: Largest difference of the baseline and of the range limit, relative to the larger one.
DEPTH = 0.1


class RigKey(BaseModel):
    """The camera of a rig and its depth sensor, as far as a request states them.

    Attributes:
        width: image width, pixels.
        height: image height, pixels.
        fx: horizontal focal length, pixels.
        fy: vertical focal length, pixels.
        cx: column of the principal point, pixels.
        cy: row of the principal point, pixels.
        baseline_m: baseline of the stereo pair that measured the depth, metres; None if none is stated.
        max_range_m: depths beyond this range count as not measured, metres; None if no limit is stated.
    """

    model_config: ClassVar[ConfigDict] = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    width: int = Field(gt=0)
    height: int = Field(gt=0)
    fx: float = Field(gt=0)
    fy: float = Field(gt=0)
    cx: float
    cy: float
    baseline_m: float | None = Field(None, gt=0)
    max_range_m: float | None = Field(None, gt=0)

    @classmethod
    def of(cls, camera: PinholeCamera, *, baseline_m: float | None, max_range_m: float | None) -> "RigKey":
        """Return the key of a rig.

        Args:
            camera: intrinsics of the rectified image.
            baseline_m: baseline of the stereo pair, metres; None if none is stated.
            max_range_m: range limit of the depth, metres; None if none is stated.
        """
        return cls(
            width=int(camera.width),
            height=int(camera.height),
            fx=float(camera.fx),
            fy=float(camera.fy),
            cx=float(camera.cx),
            cy=float(camera.cy),
            baseline_m=baseline_m,
            max_range_m=max_range_m,
        )

    def distance(self, other: "RigKey", *, other_may_lack: Collection[str] = ()) -> float | None:
        """Return how far another rig is from this one: its largest difference in units of the tolerance, 0 to 1.

        Args:
            other: the other rig.
            other_may_lack: ``baseline_m`` or ``max_range_m``, or both. If this rig states it and the other one does not, it does not count.

        Returns:
            The distance; None if a difference exceeds its tolerance, or if only one of both states the baseline or the range limit.
        """
        found = [
            _difference(self.fx / self.width, other.fx / other.width) / FIELD,
            _difference(self.fy / self.height, other.fy / other.height) / FIELD,
            abs((self.cx + 0.5) / self.width - (other.cx + 0.5) / other.width) / FIELD,
            abs((self.cy + 0.5) / self.height - (other.cy + 0.5) / other.height) / FIELD,
            _difference(float(self.width), float(other.width)) / SIZE,
            _difference(float(self.height), float(other.height)) / SIZE,
        ]
        for name in ("baseline_m", "max_range_m"):
            own, theirs = getattr(self, name), getattr(other, name)
            if own is not None and theirs is not None:
                found.append(_difference(own, theirs) / DEPTH)
            elif own is not theirs and not (theirs is None and name in other_may_lack):
                return None
        largest = max(found)
        return largest if largest <= 1.0 else None

    def is_same(self, other: "RigKey") -> bool:
        """Return whether two keys describe one rig. A range limit that only one of them states does not count.

        Args:
            other: the other key.
        """
        may_lack = ("max_range_m",)
        return (
            self.distance(other, other_may_lack=may_lack) is not None
            or other.distance(self, other_may_lack=may_lack) is not None
        )

    def stated_by_both(self, other: "RigKey") -> int:
        """Return how many of baseline and range limit both keys state.

        Args:
            other: the other key.
        """
        return sum(None not in (getattr(self, name), getattr(other, name)) for name in ("baseline_m", "max_range_m"))

    def described(self) -> str:
        """Return the rig as text for readers."""
        across, down = (
            math.degrees(math.atan((centre + 0.5) / focal) + math.atan((side - centre - 0.5) / focal))
            for side, centre, focal in ((self.width, self.cx, self.fx), (self.height, self.cy, self.fy))
        )
        baseline = "no baseline" if self.baseline_m is None else f"baseline {self.baseline_m:g} m"
        limit = "no range limit" if self.max_range_m is None else f"range limit {self.max_range_m:g} m"
        return f"{self.width} x {self.height} pixels, {across:.0f} x {down:.0f} degrees, {baseline}, {limit}"


def _difference(one: float, other: float) -> float:
    """Return the difference of two positive numbers, relative to the larger one."""
    return abs(one - other) / max(one, other)
