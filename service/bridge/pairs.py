"""Colour, depth and calibration of one instant, out of three streams that come in any order."""

from collections import OrderedDict
from dataclasses import dataclass
from typing import Any

from service.bridge.pictures import CameraInfoLike, ImageLike
from service.errors import RequestError


def nanoseconds_of(message: Any) -> int:
    """A message's stamp."""
    stamp = message.header.stamp
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """Messages that belong together."""

    color: ImageLike
    depth: ImageLike
    info: CameraInfoLike


class Pairs:
    """Puts the nearest stamps together; colour and depth are each used once.

    A calibration holds until another comes: drivers send it with every picture, others once; of those that are kept, the nearest is
    taken.

    Args:
        tolerance_s: how far the stamps of colour and depth may lie apart.
        most: messages of a stream that wait for their partner; the oldest leaves.

    Attributes:
        dropped: pictures that left without a partner.
    """

    def __init__(self, *, tolerance_s: float = 0.02, most: int = 10) -> None:
        if not tolerance_s >= 0:
            raise RequestError(f"tolerance: {tolerance_s} is no time; give seconds, as 0.02", field="tolerance")
        if most < 1:
            raise RequestError(f"queue: {most} keeps nothing; give 1 or more", field="queue")
        self._tolerance_ns = round(1e9 * tolerance_s)
        self.most = most
        self._colors: OrderedDict[int, ImageLike] = OrderedDict()
        self._depths: OrderedDict[int, ImageLike] = OrderedDict()
        self._infos: OrderedDict[int, CameraInfoLike] = OrderedDict()
        self.dropped = 0

    def color(self, message: ImageLike) -> None:
        """A colour picture has come."""
        self._keep(self._colors, message)

    def depth(self, message: ImageLike) -> None:
        """A depth picture has come."""
        self._keep(self._depths, message)

    def info(self, message: CameraInfoLike) -> None:
        """A calibration has come."""
        self._infos[nanoseconds_of(message)] = message
        while len(self._infos) > self.most:
            self._infos.popitem(last=False)

    def oldest(self) -> Pair | None:
        """The earliest pair that is whole, once; pictures older than it, which nothing can come for, are dropped."""
        found = self._matches()
        return self._take(min(found)) if found else None

    def newest(self) -> Pair | None:
        """The latest pair that is whole, once; all that is older is dropped."""
        found = self._matches()
        return self._take(max(found)) if found else None

    @property
    def waiting(self) -> int:
        """Pictures without a partner yet."""
        return len(self._colors) + len(self._depths)

    def missing(self) -> tuple[str, ...]:
        """Which streams nothing waits of: ``color``, ``depth``, ``info``."""
        streams: dict[str, OrderedDict[int, Any]] = {"color": self._colors, "depth": self._depths, "info": self._infos}
        return tuple(name for name, waiting in streams.items() if not waiting)

    def _keep(self, waiting: OrderedDict[int, ImageLike], message: ImageLike) -> None:
        at = nanoseconds_of(message)
        self.dropped += at in waiting  # a stamp that comes twice
        waiting[at] = message
        while len(waiting) > self.most:
            waiting.popitem(last=False)
            self.dropped += 1

    def _matches(self) -> list[tuple[int, int]]:
        """Stamps of colour and depth that are each other's nearest and near enough."""
        if not (self._colors and self._depths and self._infos):
            return []
        nearest = {color: _nearest(self._depths, color) for color in self._colors}
        return [
            (color, depth)
            for color, depth in nearest.items()
            if abs(color - depth) <= self._tolerance_ns and _nearest(self._colors, depth) == color
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
    """Of two that are equally near the earlier."""
    return min(waiting, key=lambda each: (abs(each - stamp), each))
