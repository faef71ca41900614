"""How every route that localizes takes its body: counted, bounded in number and in time."""

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
    """Reads bodies for an engine; one for all routes of an application."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._bodies = asyncio.Semaphore(
            engine.admission.capacity
        )  # bounds the number of bodies that are still coming in; their memory is the budget's

    async def in_time(self, work: Callable[[], T]) -> T:
        """Work that needs no body, on a worker, in no more time than a request may take.

        Raises:
            BusyError: as many wait as may.
            DeadlineError: it took too long.
        """
        settings = self.engine.settings
        try:
            async with asyncio.timeout(settings.request_timeout_s):
                return await asyncio.wrap_future(self.engine.admission.submit(work))
        except TimeoutError as error:
            raise DeadlineError(f"not done within {settings.request_timeout_s:g} s; try again later") from error

    async def __call__(self, request: Request, work: Callable[[Body], Awaitable[Response]]) -> Response:
        """Read the body and work on it.

        Raises:
            BusyError: as many come in, or wait, as may, or the memory for requests is taken.
            TooLargeError: the body is beyond the limit.
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
    """The answer; work that still waits is dropped where nobody waits for it any more.

    Raises:
        ClientDisconnect: the caller has gone.
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
    """Until the connection is closed: after a body nothing else can come."""
    while (await request.receive())["type"] != "http.disconnect":
        pass
