"""Pair each colour image by its stamp with its depth, or with the right image of a stereo rig. Only a few images wait at a time."""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

#: Greatest number of waiting messages per kind. A further message removes the oldest, which then stays unpaired.
MOST_WAITING = 30


@dataclass(frozen=True, slots=True)
class Pair:
    """Undecoded messages of the same moment.

    Attributes:
        stamp_s: time of the colour image, seconds.
        color: message of the colour image.
        partner: message of the depth image or of the right image, or None.
    """

    stamp_s: float
    color: Any
    partner: Any


@dataclass(frozen=True, slots=True)
class UnpairedImage:
    """A message without a partner.

    Attributes:
        stamp_s: time, seconds.
        role: ``color``.
    """

    stamp_s: float
    role: str


class Pairing:
    """Pair each colour image with the partner nearest in time.

    Args:
        tolerance_s: greatest time between the two, seconds.
    """

    def __init__(self, tolerance_s: float) -> None:
        self._tolerance_s = tolerance_s
        self._color: deque[tuple[float, Any]] = deque()
        self._partners: deque[tuple[float, Any]] = deque()

    def add(self, role: str, stamp_s: float, message: Any) -> Iterator[Pair | UnpairedImage]:
        """Add a message, and yield what it completes.

        Args:
            role: ``color`` or ``partner``.
            stamp_s: time, seconds.
            message: undecoded.
        """
        (self._color if role == "color" else self._partners).append((stamp_s, message))
        yield from self._settled(at_end=False)
        if len(self._color) > MOST_WAITING:
            yield UnpairedImage(self._color.popleft()[0], "color")
        if len(self._partners) > MOST_WAITING:
            self._partners.popleft()

    def finish(self) -> Iterator[Pair | UnpairedImage]:
        """Yield what waits at the end of the recording."""
        yield from self._settled(at_end=True)

    def _settled(self, *, at_end: bool) -> Iterator[Pair | UnpairedImage]:
        """Yield the colour images for which no nearer partner can follow: a partner at their time or later has arrived."""
        while self._color:
            stamp_s, message = self._color[0]
            if not at_end and (not self._partners or self._partners[-1][0] < stamp_s):
                return
            self._color.popleft()
            near = min(self._partners, key=lambda item: abs(item[0] - stamp_s), default=None)
            if near is None or abs(near[0] - stamp_s) > self._tolerance_s:
                yield UnpairedImage(stamp_s, "color")
                continue
            while self._partners and self._partners[0][0] < near[0]:
                self._partners.popleft()
            yield Pair(stamp_s, message, near[1])
