"""Body handling of every route that localizes, with limits on size, number and time."""

import asyncio
from collections.abc import Awaitable, Callable
from typing import TypeVar

from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response

from service.errors import BusyError, DeadlineError
from service.http.body import Body, read_body
from service.runtime.engine import Engine

T = TypeVar("T")


class Asking:
    """Reads bodies for an engine. All routes of an application share one.

    Args:
        engine: does the work.

    Attributes:
        engine: as given.
    """

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._bodies = asyncio.Semaphore(
            engine.admission.capacity
        )  # limits the number of bodies being received; the memory budget limits their size

    async def in_time(self, work: Callable[[], T]) -> T:
        """Run work without a body on a worker, within the time limit of a request.

        Args:
            work: to run.

        Raises:
            BusyError: the queue is full.
            DeadlineError: the work took too long.
        """
        settings = self.engine.settings
        try:
            async with asyncio.timeout(settings.request_timeout_s):
                return await asyncio.wrap_future(self.engine.admission.submit(work))
        except TimeoutError as error:
            raise DeadlineError(f"not done within {settings.request_timeout_s:g} s; try again later") from error

    async def __call__(self, request: Request, work: Callable[[Body], Awaitable[Response]]) -> Response:
        """Read the body and run the work on it.

        Args:
            request: its body has not been read yet.
            work: answers a complete body.

        Raises:
            BusyError: too many requests are being received or wait, or the memory for requests is taken.
            TooLargeError: the body exceeds the limit.
            DeadlineError: body and work took longer than a request may.
        """
        settings = self.engine.settings
        if self._bodies.locked():
            raise BusyError(
                f"{self.engine.admission.capacity} requests are coming in or wait already; try again in a second"
            )
        try:
            with self.engine.memory.hold() as hold:
                async with asyncio.timeout(settings.request_timeout_s), self._bodies:
                    content = await read_body(request, max_bytes=settings.limits.max_request_bytes, hold=hold)
                    return await _unless_gone(request, work(Body(content, hold, self.engine.admission)))
        except TimeoutError as error:
            raise DeadlineError(
                f"no answer within {settings.request_timeout_s:g} s; send the body faster, or try again later"
            ) from error


async def _unless_gone(request: Request, answering: Awaitable[Response]) -> Response:
    """Return the answer, or cancel the work if the client disconnects.

    Raises:
        ClientDisconnect: the client has disconnected.
    """
    work, gone = asyncio.ensure_future(answering), asyncio.ensure_future(_gone(request))
    try:
        await asyncio.wait((work, gone), return_when=asyncio.FIRST_COMPLETED)
        if not work.done():
            raise ClientDisconnect
        return work.result()
    finally:
        gone.cancel()
        work.cancel()


async def _gone(request: Request) -> None:
    """Wait until the connection is closed. After the body no other message can arrive."""
    while (await request.receive())["type"] != "http.disconnect":
        pass
