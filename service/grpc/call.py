"""One gRPC call: its work on the engine's workers, its deadline, and its cancellation."""

import threading
from collections.abc import Callable
from concurrent.futures import Future
from time import monotonic
from typing import TypeVar

import grpc

from service.errors import DeadlineError
from service.runtime.admission import Admission, Hold
from service.runtime.tracing import RequestSpan

T = TypeVar("T")


class Call:
    """Work of one call. If the client disconnects, waiting work is cancelled.

    Args:
        admission: of the engine.
        context: of the call.
        span: of its trace.
        timeout_s: limit of the service; the deadline of the client may be shorter.
        hold: memory of the message, kept until the work is over; None if it is held elsewhere.

    Attributes:
        span: as given.
    """

    def __init__(
        self,
        admission: Admission,
        context: grpc.ServicerContext,
        span: RequestSpan,
        *,
        timeout_s: float,
        hold: Hold | None = None,
    ) -> None:
        self.span = span
        self._admission = admission
        self._context = context
        self._timeout_s = timeout_s
        self._hold = hold
        self._lock = threading.Lock()
        self._under_way: set[Future[object]] = set()  # only unfinished work: a stream may have frames for hours
        self._gone = not context.add_callback(self._drop)
        self.begin_again()

    def begin_again(self) -> None:
        """Restart the time limit, for the next frame of a stream."""
        left = self._context.time_remaining()
        self._allowed_s = self._timeout_s if left is None else min(left, self._timeout_s)
        self._until = monotonic() + self._allowed_s

    def run(self, work: Callable[[], T]) -> T:
        """Run work on a worker and wait for the result.

        Args:
            work: to run.

        Raises:
            BusyError: the queue is full.
            DeadlineError: the work took longer than the call may.
            CancelledError: the client has disconnected.
        """
        return self.result(self.submit(work))

    def submit(self, work: Callable[[], T]) -> Future[T]:
        """Submit work to the queue.

        Args:
            work: to run.

        Raises:
            BusyError: the queue is full.
        """
        future = self._admission.submit(work)
        if self._hold is not None:
            self._hold.until(future)
        with self._lock:
            self._under_way.add(future)  # type: ignore[arg-type]  # a future of anything
            gone = self._gone
        future.add_done_callback(self._forget)
        if gone:
            future.cancel()
        return future

    def result(self, future: Future[T]) -> T:
        """Wait for the result of submitted work.

        Args:
            future: returned by ``submit``.

        Raises:
            DeadlineError: the work took longer than the call may.
            CancelledError: the client has disconnected.
        """
        try:
            return future.result(timeout=max(0.0, self._until - monotonic()))
        except TimeoutError as error:
            future.cancel()
            raise DeadlineError(
                f"no answer within {self._allowed_s:.3g} s; raise the deadline of the call, or try again later"
            ) from error

    def _forget(self, future: Future[T]) -> None:
        with self._lock:
            self._under_way.discard(future)

    def _drop(self) -> None:
        with self._lock:
            self._gone = True
            under_way = list(self._under_way)
        for future in under_way:
            future.cancel()
