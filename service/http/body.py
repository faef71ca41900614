"""Receive a request body with limits on size, number and time, and split multipart/form-data in memory.

Starlette limits form fields but not files, and writes parts over 1 MiB to temporary files. This service needs a byte limit for files
too, and may run on a read-only file system.
"""

import asyncio
import re
from collections.abc import Awaitable, Callable
from email.message import Message
from functools import lru_cache
from typing import TypeVar

from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response

from service.contract.schema import MOST_FRAMES
from service.errors import BusyError, DeadlineError, RequestError, TooLargeError, UnsupportedFormatError
from service.runtime.admission import MIB, Admission, Hold
from service.runtime.engine import Engine

T = TypeVar("T")

#: Maximum number of parts: an image pair for each frame of the longest sequence, and the JSON.
MOST_PARTS = 2 * MOST_FRAMES + 1
#: Step of the memory reservation for a body of unknown length.
_STEP = MIB
_HEADERS_AT_MOST = 4096
_BOUNDARY = re.compile(r"[0-9A-Za-z'()+_,./:=? -]{0,69}[0-9A-Za-z'()+_,./:=?-]")


async def read_body(request: Request, *, max_bytes: int, hold: Hold) -> bytearray:
    """Read the whole body, up to a limit.

    Args:
        request: its body has not been read yet.
        max_bytes: the limit.
        hold: reserves the memory: the announced length before the first byte, else step by step.

    Raises:
        TooLargeError: the announced length or the received bytes exceed the limit.
        BusyError: the memory for requests is taken.
    """
    announced = request.headers.get("content-length", "0")
    if announced.isdecimal():
        if int(announced) > max_bytes:
            raise _too_large(f"{announced} bytes", max_bytes)
        hold.grow(int(announced))
    body = bytearray()
    async for chunk in request.stream():
        if len(body) + len(chunk) > max_bytes:
            raise _too_large(f"more than {len(body)} bytes", max_bytes)
        if len(body) + len(chunk) > hold.bytes:
            hold.grow(max(_STEP, len(chunk)))
        body += chunk
    return body


class Body:
    """A complete body and its reserved memory.

    Args:
        content: the bytes; cleared when they are read.
        hold: reservation of the body.
        admission: of the engine.
    """

    def __init__(self, content: bytearray, hold: Hold, admission: Admission) -> None:
        self._content = content
        self._hold = hold
        self._admission = admission

    async def run(self, work: Callable[[], T]) -> T:
        """Run work on a worker thread. The memory of the body stays reserved until the work is over.

        Args:
            work: to run.

        Raises:
            BusyError: the queue is full.
        """
        future = self._admission.submit(work)
        self._hold.until(future)
        return await asyncio.wrap_future(future)

    def split(self, content_type: str, *, max_parts: int) -> dict[str, bytes]:
        """Split a multipart/form-data body into its parts by name, and clear the body.

        Args:
            content_type: header of the request.
            max_parts: limit of the number of parts.

        Raises:
            BusyError: the memory for requests is taken.
            StreetfixError: as for ``split_multipart``.
        """
        before = len(self._content)
        self._hold.grow(before)  # the parts are copies; the body exists until all are made
        parts = split_multipart(self._content, content_type, max_parts=max_parts)
        self._content.clear()
        self._hold.shrink_to(before)
        return parts

    def whole(self, *, copies: int) -> bytes:
        """Return the whole body and clear it. Memory for further copies is reserved.

        Args:
            copies: number of copies that the caller makes.

        Raises:
            BusyError: the memory for requests is taken.
        """
        self._hold.grow(copies * len(self._content))
        content = bytes(self._content)
        self._content.clear()
        return content


class RequestRunner:
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
            raise DeadlineError(f"not finished within {settings.request_timeout_s:g} s; try again later") from error

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
            raise BusyError(f"the queue is full ({self.engine.admission.capacity} requests); try again in a second")
        try:
            with self.engine.memory.hold() as hold:
                async with asyncio.timeout(settings.request_timeout_s), self._bodies:
                    content = await read_body(request, max_bytes=settings.limits.max_request_bytes, hold=hold)
                    return await _unless_gone(request, work(Body(content, hold, self.engine.admission)))
        except TimeoutError as error:
            raise DeadlineError(
                f"no answer within {settings.request_timeout_s:g} s; send the body faster, or try again later"
            ) from error


def split_multipart(body: bytearray, content_type: str, *, max_parts: int) -> dict[str, bytes]:
    """Split a multipart/form-data body into its parts by name.

    Args:
        body: the whole body.
        content_type: header of the request.
        max_parts: limit of the number of parts.

    Raises:
        UnsupportedFormatError: the content type is not multipart/form-data.
        RequestError: the body is malformed, or a name occurs twice.
        TooLargeError: there are more parts than the limit.
    """
    delimiter = b"\r\n--" + _boundary_of(content_type)
    # The first delimiter needs no line break before it.
    start = len(delimiter) - 2 if body.startswith(delimiter[2:]) else _next(body, delimiter, 0) + len(delimiter)
    parts: dict[str, bytes] = {}
    while not body.startswith(b"--", start):
        if len(parts) == max_parts:
            raise TooLargeError(f"the body has more than {max_parts} parts; send rgb, depth and request only")
        after_line = _next(body, b"\r\n", start, at_most=256)
        if body[start:after_line].strip(b" \t"):
            raise _malformed("a boundary must end its line, but text follows")
        end = _next(body, delimiter, after_line)
        name, content = _part(body, after_line, end)
        if name in parts:
            raise RequestError(f"the part {name!r} occurs twice; send each part once", field=name)
        parts[name] = content
        start = end + len(delimiter)
    return parts


def require_parts(parts: dict[str, bytes], names: tuple[str, ...]) -> None:
    """Require exactly the given parts.

    Args:
        parts: content by name.
        names: required names.

    Raises:
        RequestError: a part is missing or unknown.
    """
    remedy = f"send the parts {', '.join(names[:-1])} and {names[-1]}"
    for name in names:
        if name not in parts:
            raise RequestError(f"the part {name!r} is missing; {remedy}", field=name)
    if unknown := sorted(set(parts) - set(names)):
        raise RequestError(f"the part {unknown[0]!r} is unknown; {remedy}", field=unknown[0])


def document_of(parts: dict[str, bytes]) -> bytes:
    """Return the JSON part.

    Args:
        parts: content by name.

    Raises:
        RequestError: the part is missing.
    """
    if "request" not in parts:
        raise RequestError("the part 'request' is missing; send it as JSON that describes the images", field="request")
    return parts["request"]


def numbered_pictures(parts: dict[str, bytes], count: int) -> list[tuple[bytes, bytes]]:
    """Return the image pairs (rgb0, depth0), (rgb1, depth1) and so on.

    Args:
        parts: content by name.
        count: number of pairs.

    Raises:
        RequestError: a part is missing or unknown.
    """
    require_parts(parts, (*(f"{kind}{k}" for k in range(count) for kind in ("rgb", "depth")), "request"))
    return [(parts[f"rgb{k}"], parts[f"depth{k}"]) for k in range(count)]


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


def _too_large(what: str, max_bytes: int) -> TooLargeError:
    return TooLargeError(
        f"the body has {what}, but the limit is {max_bytes} bytes; send smaller or more compressed images"
    )


def _boundary_of(content_type: str) -> bytes:
    header = Message()
    header["content-type"] = content_type
    if header.get_content_type() != "multipart/form-data":
        raise UnsupportedFormatError(
            f"the content type is {content_type[:80]!r}; send multipart/form-data with the parts rgb, depth and request"
        )
    boundary = header.get_param("boundary")
    if not isinstance(boundary, str) or not _BOUNDARY.fullmatch(boundary):
        raise _malformed(f"the content type {content_type[:80]!r} has no valid boundary")
    return boundary.encode("ascii")


def _part(body: bytearray, start: int, end: int) -> tuple[str, bytes]:
    """Return name and content of the part between two delimiters. ``start`` is at the line break after the first one."""
    blank = body.find(b"\r\n\r\n", start, min(end, start + _HEADERS_AT_MOST))
    if blank < 0:
        raise _malformed(f"a part has no headers, or more than {_HEADERS_AT_MOST} bytes of them")
    for line in bytes(body[start:blank]).split(b"\r\n"):
        name, _, value = line.partition(b":")
        if name.strip().lower() == b"content-disposition":
            return _name_from(value.decode("utf-8", "replace")), bytes(memoryview(body)[blank + 4 : end])
    raise _malformed('a part has no header Content-Disposition: form-data; name="..."')


@lru_cache(
    maxsize=64
)  # a client repeats the same few headers, and the library's parser is the most expensive step of splitting
def _name_from(disposition: str) -> str:
    header = Message()
    header["content-disposition"] = disposition.strip()
    name = header.get_param("name", header="content-disposition")
    if header.get_content_disposition() != "form-data" or not isinstance(name, str) or not name:
        raise _malformed(f"the header Content-Disposition {disposition.strip()[:80]!r} is not form-data with a name")
    return name[:64]


def _next(body: bytearray, token: bytes, start: int, *, at_most: int | None = None) -> int:
    found = body.find(token, start, None if at_most is None else start + at_most)
    if found < 0:
        raise _malformed("the body ends before its last boundary, so a part of it is missing")
    return found


def _malformed(what: str) -> RequestError:
    return RequestError(f"the body is not valid multipart/form-data: {what}; build it with an HTTP library")
