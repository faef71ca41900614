"""An event that signal handlers may set."""

import queue
from contextlib import suppress


class Wakeup:
    """Like ``threading.Event`` for a single waiting thread, but ``set`` may be called from a signal handler.

    A handler runs in the main thread, between any two instructions. ``threading.Event.set`` takes a lock; a handler that interrupts another
    one inside it, or the main thread inside ``wait``, waits for that lock for ever. ``queue.SimpleQueue.put`` is reentrant.
    """

    def __init__(self) -> None:
        self._is_set = False
        self._queue: queue.SimpleQueue[None] = queue.SimpleQueue()

    def set(self) -> None:
        """Wake who waits; safe in a signal handler."""
        self._is_set = True
        self._queue.put(None)

    def is_set(self) -> bool:
        """Whether it was set since it was cleared."""
        return self._is_set

    def clear(self) -> None:
        """Forget that it was set."""
        self._is_set = False
        with suppress(queue.Empty):
            while True:
                self._queue.get_nowait()

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until it is set, at most so long; whether it is set."""
        if not self._is_set:
            with suppress(queue.Empty):
                self._queue.get(timeout=timeout_s)
        return self._is_set
