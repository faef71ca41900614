"""Ends calls whose client does not go on: one thread for all of them, in place of a timer for each."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager


class Patience:
    """Calls functions when waits have lasted too long; to the nearest quarter of a second."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._until: dict[int, tuple[float, Callable[[], object]]] = {}
        self._next = 0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="streetfix-patience", daemon=True)

    def start(self) -> None:
        """Begin to look."""
        self._thread.start()

    def stop(self) -> None:
        """End the thread."""
        self._stop.set()

    @contextmanager
    def at_most(self, seconds: float, give_up: Callable[[], object]) -> Iterator[None]:
        """What is inside may take so long."""
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
