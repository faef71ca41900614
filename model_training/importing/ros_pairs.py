"""Colour and depth of one camera brought together by their stamps, a few waiting at a time."""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

#: Messages of a kind that wait for their other half; later ones push out the oldest, which then counts as alone.
MOST_WAITING = 30


@dataclass(frozen=True, slots=True)
class Pair:
    """Undecoded messages of the same moment."""

    stamp_s: float
    color: Any
    depth: Any


@dataclass(frozen=True, slots=True)
class Alone:
    """A message without its other half."""

    stamp_s: float
    role: str


class Pairing:
    """Gives each colour picture the depth that is nearest to it in time.

    Args:
        tolerance_s: further apart they are not of one moment.
    """

    def __init__(self, tolerance_s: float) -> None:
        self._tolerance_s = tolerance_s
        self._color: deque[tuple[float, Any]] = deque()
        self._depth: deque[tuple[float, Any]] = deque()

    def add(self, role: str, stamp_s: float, message: Any) -> Iterator[Pair | Alone]:
        """Take a message of ``color`` or ``depth``; gives what it completes."""
        (self._color if role == "color" else self._depth).append((stamp_s, message))
        yield from self._settled(at_end=False)
        if len(self._color) > MOST_WAITING:
            yield Alone(self._color.popleft()[0], "color")
        if len(self._depth) > MOST_WAITING:
            self._depth.popleft()

    def finish(self) -> Iterator[Pair | Alone]:
        """What was still waiting when the recording ended."""
        yield from self._settled(at_end=True)

    def _settled(self, *, at_end: bool) -> Iterator[Pair | Alone]:
        """Colours for which no nearer depth can come any more: a depth as late as they are, or later, is there."""
        while self._color:
            stamp_s, message = self._color[0]
            if not at_end and (not self._depth or self._depth[-1][0] < stamp_s):
                return
            self._color.popleft()
            near = min(self._depth, key=lambda item: abs(item[0] - stamp_s), default=None)
            if near is None or abs(near[0] - stamp_s) > self._tolerance_s:
                yield Alone(stamp_s, "color")
                continue
            while self._depth and self._depth[0][0] < near[0]:
                self._depth.popleft()
            yield Pair(stamp_s, message, near[1])
