"""A bounded pool of workers: so many at work, so many waiting, the next is refused at once."""

import threading
import traceback
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

from service.errors import BusyError

T = TypeVar("T")


class Admission:
    """Runs tasks on a few threads; refuses beyond a bounded queue."""

    def __init__(self, *, threads: int, queue: int, initializer: Callable[[], None] | None = None) -> None:
        self.capacity = threads + queue
        self._lock = threading.Lock()
        self._taken = 0
        self._working = 0
        self._told_working: Callable[[float], None] = lambda _: None
        self._told_waiting: Callable[[float], None] = lambda _: None
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix="streetfix", initializer=initializer)

    def watch(self, working: Callable[[float], None], waiting: Callable[[float], None]) -> None:
        """Tell the numbers of tasks at work and waiting whenever they change."""
        self._told_working, self._told_waiting = working, waiting
        self._tell()

    @property
    def working(self) -> int:
        """Tasks that a worker runs now."""
        return self._working

    @property
    def waiting(self) -> int:
        """Tasks that wait for a worker."""
        return max(0, self._taken - self._working)

    def submit(self, task: Callable[[], T]) -> Future[T]:
        """Run a task on a worker; a cancelled future that still waits gives its place back and never runs.

        Raises:
            BusyError: all workers are at work and the queue is full.
        """
        with self._lock:
            if self._taken == self.capacity:
                raise BusyError(f"{self.capacity} requests are being worked on or wait already; try again in a second")
            self._taken += 1
            self._tell()
        # In a cell that is emptied when the work is over: a cancelled future stays in the pool's queue until a worker comes by, and
        # must not keep a request's pictures there.
        cell: list[Callable[[], T]] = [task]
        try:
            future = self._pool.submit(self._run, cell)
        except RuntimeError as error:
            self._give_back()
            raise BusyError("the service is shutting down; try another instance") from error
        del task

        def over(_: Future[T]) -> None:
            cell.clear()
            self._give_back()

        future.add_done_callback(over)
        return future

    def close(self) -> None:
        """Let running tasks end, drop waiting ones."""
        self._pool.shutdown(wait=True, cancel_futures=True)

    def _run(self, cell: list[Callable[[], T]]) -> T:
        with self._lock:
            self._working += 1
            self._tell()
        try:
            return cell.pop()()
        except BaseException as error:
            forget_locals(error)
            raise
        finally:
            with self._lock:
                self._working -= 1
                self._tell()

    def _give_back(self) -> None:
        with self._lock:
            self._taken -= 1
            self._tell()

    def _tell(self) -> None:
        self._told_working(self._working)
        self._told_waiting(max(0, self._taken - self._working))


def forget_locals(error: BaseException) -> None:
    """Drop the variables of the functions that an error has left: its traceback would keep a request's pictures as long as it lives.

    Futures and the functions that wait for them refer to each other through their error, so that can be until the garbage collector
    comes by.
    """
    seen: set[int] = set()
    one: BaseException | None = error
    while one is not None and id(one) not in seen:
        seen.add(id(one))
        traceback.clear_frames(one.__traceback__)
        one = one.__cause__ or one.__context__
