"""A bounded pool of workers: so many at work, so many waiting, the next is refused at once."""

import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

from service.errors import BusyError

T = TypeVar("T")


class Admission:
    """Runs tasks on a few threads; refuses beyond a bounded queue."""

    def __init__(self, *, threads: int, queue: int, initializer: Callable[[], None] | None = None) -> None:
        self.capacity = threads + queue
        self._slots = threading.Semaphore(self.capacity)
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix="streetfix", initializer=initializer)

    def submit(self, task: Callable[[], T]) -> Future[T]:
        """Run a task on a worker; a cancelled future that still waits gives its place back and never runs.

        Raises:
            BusyError: all workers are at work and the queue is full.
        """
        if not self._slots.acquire(blocking=False):
            raise BusyError(f"{self.capacity} requests are being worked on or wait already; try again in a second")
        try:
            future = self._pool.submit(task)
        except RuntimeError as error:
            self._slots.release()
            raise BusyError("the service is shutting down; try another instance") from error
        future.add_done_callback(lambda _: self._slots.release())
        return future

    def close(self) -> None:
        """Let running tasks end, drop waiting ones."""
        self._pool.shutdown(wait=True, cancel_futures=True)
