"""Work that requests will probably need soon, in one background thread."""

import threading
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress

from service.errors import StreetfixError

#: Largest number of items that wait. The oldest ones are dropped.
MOST_WAITING = 64


class Ahead:
    """Does expected work in one background thread: the newest expectation first, each item once. Threads may share it.

    Several robots expect different items. So a new expectation comes before the earlier ones and does not replace them.

    Args:
        work: does the work of an item. Its errors of the map and of the file system are dropped, because the request that needs the item
            does the same work and reports them.
    """

    def __init__(self, work: Callable[[int], object]) -> None:
        self._work = work
        self._waiting = deque[int]()
        self._current: int | None = None
        self._is_running = False
        self._changing = threading.Lock()

    @property
    def waiting(self) -> tuple[int, ...]:
        """Items that wait, the next one first."""
        with self._changing:
            return tuple(self._waiting)

    def expect(self, items: Sequence[int], *, is_ordered: bool) -> None:
        """Add items, without waiting for their work.

        Args:
            items: the most probable first. They come before those of earlier calls.
            is_ordered: False if the order says little. If all items wait already, they then keep their places.
        """
        with self._changing:
            if not is_ordered and set(items) <= {*self._waiting, self._current}:
                return
            new = [item for item in dict.fromkeys(items) if item != self._current]
            self._waiting = deque([*new, *(item for item in self._waiting if item not in new)][:MOST_WAITING])
            if self._is_running or not self._waiting:
                return
            self._is_running = True
        threading.Thread(target=self._run, name="open tiles ahead", daemon=True).start()

    def _run(self) -> None:
        try:
            while (item := self._next()) is not None:
                with suppress(StreetfixError, OSError):
                    self._work(item)
        except BaseException:  # a defect; the next expectation starts a new thread
            with self._changing:
                self._current, self._is_running = None, False
            raise

    def _next(self) -> int | None:
        with self._changing:
            self._current = self._waiting.popleft() if self._waiting else None
            self._is_running = self._current is not None
            return self._current
