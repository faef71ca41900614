"""Match RGB images, depth images and calibrations by time stamp. The three streams may arrive in any order."""

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from service.bridge.pictures import CameraInfoLike, ImageLike
from service.errors import RequestError


def nanoseconds_of(message: Any) -> int:
    """Return the time stamp of a message in nanoseconds.

    Args:
        message: with a ROS header.
    """
    stamp = message.header.stamp
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """Messages with matching time stamps.

    Attributes:
        color: RGB image.
        depth: depth image.
        info: calibration of the RGB camera.
    """

    color: ImageLike
    depth: ImageLike
    info: CameraInfoLike


class Pairs:
    """Matches messages with the nearest time stamps. Each RGB and depth image is used once.

    Some drivers send a calibration with every image, others only once. So calibrations are kept, and the nearest one is used.

    Args:
        tolerance_s: maximum difference between the stamps of RGB and depth image, s.
        most: maximum number of waiting messages per stream. The oldest one is dropped.

    Attributes:
        most: as given.
        dropped: number of images that were dropped without a partner.

    Raises:
        RequestError: a parameter is out of bounds.
    """

    def __init__(self, *, tolerance_s: float = 0.02, most: int = 10) -> None:
        if not tolerance_s >= 0:
            raise RequestError(
                f"tolerance: {tolerance_s} is not a valid time; give seconds, such as 0.02", field="tolerance"
            )
        if most < 1:
            raise RequestError(f"queue: {most} is not a valid size; give 1 or more", field="queue")
        self._tolerance_ns = round(1e9 * tolerance_s)
        self.most = most
        self._colors: OrderedDict[int, ImageLike] = OrderedDict()
        self._depths: OrderedDict[int, ImageLike] = OrderedDict()
        self._infos: OrderedDict[int, CameraInfoLike] = OrderedDict()
        self.dropped = 0

    def color(self, message: ImageLike) -> None:
        """Add an RGB image.

        Args:
            message: the image.
        """
        self._keep(self._colors, message)

    def depth(self, message: ImageLike) -> None:
        """Add a depth image.

        Args:
            message: the image.
        """
        self._keep(self._depths, message)

    def info(self, message: CameraInfoLike) -> None:
        """Add a calibration.

        Args:
            message: of the RGB camera.
        """
        self._infos[nanoseconds_of(message)] = message
        while len(self._infos) > self.most:
            self._infos.popitem(last=False)

    def oldest(self, is_ready: Callable[[int], bool] = lambda _: True) -> Pair | None:
        """Take the oldest complete pair and drop older images; None if there is no pair.

        Args:
            is_ready: whether a pair may be taken, by the stamp of its RGB image in ns.
        """
        found = self._matches(is_ready)
        return self._take(min(found)) if found else None

    def newest(self, is_ready: Callable[[int], bool] = lambda _: True) -> Pair | None:
        """Take the newest complete pair and drop older images; None if there is no pair.

        Args:
            is_ready: whether a pair may be taken, by the stamp of its RGB image in ns.
        """
        found = self._matches(is_ready)
        return self._take(max(found)) if found else None

    def has_pair(self) -> bool:
        """Return whether a complete pair waits."""
        return bool(self._matches(lambda _: True))

    def camera_frame(self) -> str | None:
        """Return the frame of the newest waiting RGB image; None if there is none."""
        return str(self._colors[max(self._colors)].header.frame_id) if self._colors else None

    @property
    def waiting(self) -> int:
        """Number of images that have no partner yet."""
        return len(self._colors) + len(self._depths)

    def missing(self) -> tuple[str, ...]:
        """Return the streams without any kept message: ``color``, ``depth``, ``info``."""
        streams: dict[str, OrderedDict[int, Any]] = {"color": self._colors, "depth": self._depths, "info": self._infos}
        return tuple(name for name, waiting in streams.items() if not waiting)

    def _keep(self, waiting: OrderedDict[int, ImageLike], message: ImageLike) -> None:
        at = nanoseconds_of(message)
        self.dropped += at in waiting  # a second image with the same stamp replaces the first
        waiting[at] = message
        while len(waiting) > self.most:
            waiting.popitem(last=False)
            self.dropped += 1

    def _matches(self, is_ready: Callable[[int], bool]) -> list[tuple[int, int]]:
        """Return stamps of RGB and depth images that are mutually nearest and within the tolerance."""
        if not (self._colors and self._depths and self._infos):
            return []
        nearest = {color: _nearest(self._depths, color) for color in self._colors}
        return [
            (color, depth)
            for color, depth in nearest.items()
            if abs(color - depth) <= self._tolerance_ns and _nearest(self._colors, depth) == color and is_ready(color)
        ]

    def _take(self, stamps: tuple[int, int]) -> Pair:
        color, depth = stamps
        pair = Pair(self._colors.pop(color), self._depths.pop(depth), self._infos[_nearest(self._infos, color)])
        for waiting, taken in ((self._colors, color), (self._depths, depth)):
            for old in [stamp for stamp in waiting if stamp < taken]:
                del waiting[old]
                self.dropped += 1
        return pair


def _nearest(waiting: "OrderedDict[int, Any]", stamp: int) -> int:
    """Return the nearest stamp; of two equally near ones the earlier."""
    return min(waiting, key=lambda each: (abs(each - stamp), each))
