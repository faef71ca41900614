"""A thread pool with a bounded queue. It refuses a task at once if the queue is full."""

import threading
import traceback
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

from service.errors import BusyError

T = TypeVar("T")


class Admission:
    """Runs tasks on worker threads and refuses tasks beyond a bounded queue.

    Args:
        threads: number of worker threads.
        queue: number of tasks that may wait.
        initializer: called once in every worker thread.

    Attributes:
        capacity: tasks that may run or wait at the same time.
    """

    def __init__(self, *, threads: int, queue: int, initializer: Callable[[], None] | None = None) -> None:
        self.capacity = threads + queue
        self._lock = threading.Lock()
        self._taken = 0
        self._working = 0
        self._told_working: Callable[[float], None] = lambda _: None
        self._told_waiting: Callable[[float], None] = lambda _: None
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix="streetfix", initializer=initializer)

    def watch(self, working: Callable[[float], None], waiting: Callable[[float], None]) -> None:
        """Report the number of running and of waiting tasks at every change.

        Args:
            working: called with the number of running tasks.
            waiting: called with the number of waiting tasks.
        """
        self._told_working, self._told_waiting = working, waiting
        self._tell()

    @property
    def working(self) -> int:
        """Number of tasks that a worker runs now."""
        return self._working

    @property
    def waiting(self) -> int:
        """Number of tasks that wait for a worker."""
        return max(0, self._taken - self._working)

    def submit(self, task: Callable[[], T]) -> Future[T]:
        """Run a task on a worker.

        A waiting task whose future is cancelled frees its place and never runs.

        Args:
            task: to run.

        Raises:
            BusyError: all workers are busy and the queue is full, or the service is shutting down.
        """
        with self._lock:
            if self._taken == self.capacity:
                raise BusyError(f"{self.capacity} requests are being worked on or wait already; try again in a second")
            self._taken += 1
            self._tell()
        # The cell is emptied when the task is over. A cancelled future stays in the pool's queue until a worker takes it, and must
        # not keep the images of its request in memory.
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
        """Wait for running tasks and drop waiting ones."""
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
    """Clear the local variables in the tracebacks of an error, its causes and contexts.

    A traceback keeps the images of a request in memory. Futures and the functions that wait for them refer to each other through
    their error, so this memory would stay until the next garbage collection.

    Args:
        error: raised by a task.
    """
    seen: set[int] = set()
    one: BaseException | None = error
    while one is not None and id(one) not in seen:
        seen.add(id(one))
        traceback.clear_frames(one.__traceback__)
        one = one.__cause__ or one.__context__
