"""One call: its work on the engine's workers, its deadline, and what becomes of the work when the caller goes away."""

import threading
from collections.abc import Callable
from concurrent.futures import Future
from time import monotonic
from typing import TypeVar

import grpc

from service.errors import DeadlineError
from service.runtime.admission import Admission
from service.runtime.memory import Hold
from service.runtime.tracing import RequestSpan

T = TypeVar("T")


class Call:
    """Work of one call; dropped, where it still waits, if the caller goes away.

    Args:
        admission: of the engine.
        context: of the call.
        span: of its trace.
        timeout_s: that the service allows; the caller's deadline may be shorter.
        hold: memory of the call's message, kept until the work is over; None where somebody else keeps it.
    """

    def __init__(
        self, admission: Admission, context: grpc.ServicerContext, span: RequestSpan, *, timeout_s: float, hold: Hold | None = None
    ) -> None:  # fmt: skip
        self.span = span
        self._admission = admission
        self._context = context
        self._timeout_s = timeout_s
        self._hold = hold
        self._lock = threading.Lock()
        self._under_way: set[Future[object]] = set()  # no more than these: a stream's call has frames for hours
        self._gone = not context.add_callback(self._drop)
        self.begin_again()

    def begin_again(self) -> None:
        """Give what follows the whole time that a request may take: the next frame of a stream."""
        left = self._context.time_remaining()
        self._allowed_s = self._timeout_s if left is None else min(left, self._timeout_s)
        self._until = monotonic() + self._allowed_s

    def run(self, work: Callable[[], T]) -> T:
        """Do work on a worker and wait for it.

        Raises:
            BusyError: the queue is full.
            DeadlineError: it took longer than the call may.
        """
        return self.result(self.submit(work))

    def submit(self, work: Callable[[], T]) -> Future[T]:
        """Queue work.

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
        """Wait for work.

        Raises:
            DeadlineError: it took longer than the call may.
            CancelledError: the caller has gone.
        """
        try:
            return future.result(timeout=max(0.0, self._until - monotonic()))
        except TimeoutError as error:
            future.cancel()
            raise DeadlineError(
                f"no answer within {self._allowed_s:.3g} s; allow more time, or try again later"
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
