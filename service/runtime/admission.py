"""What a process accepts: tasks on its worker threads, and bytes of memory for all requests, REST and gRPC.

Both have a limit. A request that does not fit is refused at once. A request reserves its memory before it allocates. So a flood of
large requests causes refusals and not a killed container.
"""

import threading
import traceback
import weakref
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType
from typing import Any, Self, TypeVar

from service.errors import BusyError, TooLargeError
from service.heap import LARGE_BYTES, Trimmer

T = TypeVar("T")

MIB = 2**20


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
                raise BusyError(f"the queue is full ({self.capacity} requests); try again in a second")
            self._taken += 1
            self._tell()
        # The cell is emptied when the task is over. A cancelled future stays in the pool's queue until a worker takes it, and must
        # not keep the images of its request in memory.
        cell: list[Callable[[], T]] = [task]
        try:
            future = self._pool.submit(self._run, cell)
        except RuntimeError as error:
            self._give_back()
            raise BusyError("the service is stopping; use another instance") from error
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


class MemoryBudget:
    """Bytes that all requests together may hold. It is thread-safe.

    Args:
        limit: bytes.
        messages: number of gRPC messages of the largest size that may be read at once, outside the limit.
    """

    def __init__(self, limit: int, messages: int = 0) -> None:
        self.limit = limit
        self.messages = messages
        self._lock = threading.Lock()
        self._held = 0
        # Finalizers of images may run while this thread holds the lock. So they only append here and never take the lock.
        self._returned: deque[int] = deque()
        self._callback: Callable[[float], None] = lambda _: None
        self._trimmer = Trimmer()

    @property
    def held(self) -> int:
        """Number of bytes that are reserved now."""
        with self._lock:
            self._take_back()
            return self._held

    def watch(self, callback: Callable[[float], None]) -> None:
        """Report the reserved bytes now and after every change.

        Args:
            callback: called with the number of bytes.
        """
        self._callback = callback
        callback(self.held)

    def hold(self) -> "Hold":
        """Create an empty reservation that can grow."""
        return Hold(self)

    def reserve(self, count: int) -> bool:
        """Reserve bytes if they fit; return whether they did.

        Args:
            count: bytes.
        """
        with self._lock:
            self._take_back()
            if self._held + count > self.limit:
                return False
            self._held += count
            self._callback(self._held)
            return True

    def give_back(self, count: int) -> None:
        """Release reserved bytes.

        Args:
            count: bytes.
        """
        with self._lock:
            self._take_back()
            self._held -= count
            self._callback(self._held)
        self.freed(count)

    def freed(self, count: int) -> None:
        """Return freed memory to the system if it is large.

        Args:
            count: bytes that were freed.
        """
        if count >= LARGE_BYTES:
            self._trimmer.soon()

    def give_back_later(self, count: int) -> None:
        """Release reserved bytes at the next access to the budget. Safe to call from a finalizer, because it takes no lock.

        Args:
            count: bytes.
        """
        self._returned.append(count)

    def _take_back(self) -> None:
        while self._returned:
            self._held -= self._returned.popleft()


class Hold:
    """Bytes that one request holds.

    Use it as a context manager. The bytes are released when the context and all work that was passed to ``until`` have ended.

    Args:
        budget: in which the bytes are reserved.

    Attributes:
        bytes: reserved now.
    """

    def __init__(self, budget: MemoryBudget) -> None:
        self._budget = budget
        self._lock = threading.Lock()
        self._users = 1  # the request itself, and the work for it
        self.bytes = 0

    def __enter__(self) -> Self:
        """Return the hold; nothing is reserved yet."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Release the bytes once all work is over."""
        self._one_less()

    def grow(self, count: int) -> None:
        """Reserve more bytes before they are allocated.

        Args:
            count: additional bytes.

        Raises:
            TooLargeError: the request alone exceeds the budget.
            BusyError: other requests hold too much now.
        """
        if self._budget.reserve(count):
            self.bytes += count
            return
        needed, limit = self.bytes + count, self._budget.limit
        if needed > limit:
            raise TooLargeError(
                f"the request needs {in_mib(needed)} of memory, but this service has {in_mib(limit)} for requests; send "
                "smaller or fewer images, or let the operator raise STREETFIX_REQUEST_MEMORY_MIB"
            )
        raise BusyError(
            f"the memory for requests is full (this request needs {in_mib(needed)} of {in_mib(limit)}); try again in a second"
        )

    def shrink_to(self, count: int) -> None:
        """Release the bytes above a count.

        Args:
            count: bytes to keep.
        """
        if count < self.bytes:
            self._budget.give_back(self.bytes - count)
            self.bytes = count

    def until(self, work: "Future[Any]") -> None:
        """Keep the bytes at least until some work is over, even if the caller disconnects.

        Args:
            work: future of the work.
        """
        with self._lock:
            self._users += 1
        work.add_done_callback(lambda _: self._one_less())

    def leave_with(self, owner: Any, count: int | None = None) -> None:
        """Transfer bytes to an object. They are released when the object is deleted.

        Args:
            owner: any object that supports weak references.
            count: how many of the reserved bytes; None for all.
        """
        moved = self.bytes if count is None else count
        if moved:
            weakref.finalize(owner, self._budget.give_back_later, moved).atexit = False
        self.bytes -= moved

    def _one_less(self) -> None:
        with self._lock:
            self._users -= 1
            over = self._users == 0
        if over:
            self.shrink_to(0)


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


def in_mib(count: float) -> str:
    """Return a number of bytes as text in MiB.

    Args:
        count: bytes.
    """
    return f"{count / MIB:.0f} MiB"
