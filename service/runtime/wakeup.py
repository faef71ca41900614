"""An event that signal handlers may set."""

import queue
from contextlib import suppress


class Wakeup:
    """Like ``threading.Event`` for a single waiting thread, but ``set`` may be called from a signal handler.

    A handler runs in the main thread, between any two instructions. ``threading.Event.set`` takes a lock. A handler may interrupt
    another handler inside ``set``, or the main thread inside ``wait``. It would then wait for that lock forever.
    ``queue.SimpleQueue.put`` is reentrant.
    """

    def __init__(self) -> None:
        self._is_set = False
        self._queue: queue.SimpleQueue[None] = queue.SimpleQueue()

    def set(self) -> None:
        """Wake the waiting thread. Safe to call from a signal handler."""
        self._is_set = True
        self._queue.put(None)

    def is_set(self) -> bool:
        """Return whether the event was set since the last ``clear``."""
        return self._is_set

    def clear(self) -> None:
        """Reset the event."""
        self._is_set = False
        with suppress(queue.Empty):
            while True:
                self._queue.get_nowait()

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until the event is set; return whether it is set.

        Args:
            timeout_s: maximum wait in seconds; None waits without limit.
        """
        if not self._is_set:
            with suppress(queue.Empty):
                self._queue.get(timeout=timeout_s)
        return self._is_set
