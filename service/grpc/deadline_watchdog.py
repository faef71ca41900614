"""End calls whose client stays silent. One thread watches all of them, instead of one timer per call."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager


class DeadlineWatchdog:
    """Watchdog that calls a function when a wait takes too long. It checks every 0.25 s."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._until: dict[int, tuple[float, Callable[[], object]]] = {}
        self._next = 0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="streetfix-deadlines", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """End the thread."""
        self._stop.set()

    @contextmanager
    def time_limit(self, seconds: float, give_up: Callable[[], object]) -> Iterator[None]:
        """Limit the duration of the context.

        Args:
            seconds: the limit.
            give_up: called once, in the thread of the watchdog, if the limit is exceeded.
        """
        with self._lock:
            number, self._next = self._next, self._next + 1
            self._until[number] = (time.monotonic() + seconds, give_up)
        try:
            yield
        finally:
            with self._lock:
                self._until.pop(number, None)

    def _run(self) -> None:
        while not self._stop.wait(0.25):
            now = time.monotonic()
            with self._lock:
                late = [number for number, (until, _) in self._until.items() if until < now]
                calls = [self._until.pop(number)[1] for number in late]
            for call in calls:
                call()
