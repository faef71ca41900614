"""Read a request's body with its bytes counted, and split multipart/form-data without copying it to disk.

Starlette bounds form fields but no files, and spools parts over 1 MiB to temporary files; a service with a read-only
file system and a limit of bytes does neither.
"""

import asyncio
import re
from collections.abc import Callable
from email.message import Message
from functools import lru_cache
from typing import TypeVar

from starlette.requests import Request

from service.errors import RequestError, TooLargeError, UnsupportedFormatError
from service.runtime.admission import Admission
from service.runtime.memory import MIB, Hold

T = TypeVar("T")

#: A body of unknown length reserves memory in such steps.
_STEP = MIB
_HEADERS_AT_MOST = 4096
_BOUNDARY = re.compile(r"[0-9A-Za-z'()+_,./:=? -]{0,69}[0-9A-Za-z'()+_,./:=?-]")


async def read_body(request: Request, *, max_bytes: int, hold: Hold) -> bytearray:
    """The whole body, never more than the limit.

    Args:
        request: whose body has not been read.
        max_bytes: the limit.
        hold: where its memory is reserved: the announced length before a byte is read, else step by step as it comes.

    Raises:
        TooLargeError: the length announced, or the bytes that came, are beyond the limit.
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
            raise _too_large(f"over {len(body)} bytes so far", max_bytes)
        if len(body) + len(chunk) > hold.bytes:
            hold.grow(max(_STEP, len(chunk)))
        body += chunk
    return body


class Body:
    """A body that has come in whole, and the memory that it holds.

    Args:
        content: gone when it was read.
        hold: its reservation.
        admission: of the engine.
    """

    def __init__(self, content: bytearray, hold: Hold, admission: Admission) -> None:
        self._content = content
        self._hold = hold
        self._admission = admission

    async def run(self, work: Callable[[], T]) -> T:
        """Work on it, on a worker; its memory stays reserved until that is over.

        Raises:
            BusyError: the queue is full.
        """
        future = self._admission.submit(work)
        self._hold.until(future)
        return await asyncio.wrap_future(future)

    def split(self, content_type: str, *, max_parts: int) -> dict[str, bytes]:
        """The parts of a multipart/form-data body by their names.

        Raises:
            BusyError: the memory for requests is taken.
            StreetfixError: as ``split_multipart``.
        """
        before = len(self._content)
        self._hold.grow(before)  # parts are copies, beside the body until all are made
        parts = split_multipart(self._content, content_type, max_parts=max_parts)
        self._content.clear()
        self._hold.shrink_to(before)
        return parts

    def whole(self, *, copies: int) -> bytes:
        """All of it, for a reader that makes so many copies.

        Raises:
            BusyError: the memory for requests is taken.
        """
        self._hold.grow(copies * len(self._content))
        content = bytes(self._content)
        self._content.clear()
        return content


def _too_large(what: str, max_bytes: int) -> TooLargeError:
    return TooLargeError(
        f"the body has {what}; this service takes {max_bytes}: send smaller or better compressed pictures"
    )


def split_multipart(body: bytearray, content_type: str, *, max_parts: int) -> dict[str, bytes]:
    """The parts of a multipart/form-data body by their names.

    Raises:
        UnsupportedFormatError: the content type is another one.
        RequestError: the body is not well formed, or a name comes twice.
        TooLargeError: more parts than the limit.
    """
    delimiter = b"\r\n--" + _boundary_of(content_type)
    # The first delimiter has no line break before it.
    start = len(delimiter) - 2 if body.startswith(delimiter[2:]) else _next(body, delimiter, 0) + len(delimiter)
    parts: dict[str, bytes] = {}
    while not body.startswith(b"--", start):
        if len(parts) == max_parts:
            raise TooLargeError(f"the body has more than {max_parts} parts; send rgb, depth and request only")
        after_line = _next(body, b"\r\n", start, at_most=256)
        if body[start:after_line].strip(b" \t"):
            raise _malformed("there is text after a boundary")
        end = _next(body, delimiter, after_line)
        name, content = _part(body, after_line, end)
        if name in parts:
            raise RequestError(f"the part {name!r} comes twice; send each part once", field=name)
        parts[name] = content
        start = end + len(delimiter)
    return parts


def _boundary_of(content_type: str) -> bytes:
    header = Message()
    header["content-type"] = content_type
    if header.get_content_type() != "multipart/form-data":
        raise UnsupportedFormatError(
            f"the content type is {content_type[:80]!r}; send multipart/form-data with the parts rgb, depth and request"
        )
    boundary = header.get_param("boundary")
    if not isinstance(boundary, str) or not _BOUNDARY.fullmatch(boundary):
        raise _malformed("its content type names no valid boundary")
    return boundary.encode("ascii")


def _part(body: bytearray, start: int, end: int) -> tuple[str, bytes]:
    """Name and content of the part between two delimiters; ``start`` is at the line break after the first."""
    blank = body.find(b"\r\n\r\n", start, min(end, start + _HEADERS_AT_MOST))
    if blank < 0:
        raise _malformed("a part has no headers, or more than 4 KiB of them")
    for line in bytes(body[start:blank]).split(b"\r\n"):
        name, _, value = line.partition(b":")
        if name.strip().lower() == b"content-disposition":
            return _name_from(value.decode("utf-8", "replace")), bytes(memoryview(body)[blank + 4 : end])
    raise _malformed("a part has no Content-Disposition")


@lru_cache(
    maxsize=64
)  # a client sends the same few for every request, and the library's parser is the dearest step of splitting
def _name_from(disposition: str) -> str:
    header = Message()
    header["content-disposition"] = disposition.strip()
    name = header.get_param("name", header="content-disposition")
    if header.get_content_disposition() != "form-data" or not isinstance(name, str) or not name:
        raise _malformed("a part has no name")
    return name[:64]


def _next(body: bytearray, token: bytes, start: int, *, at_most: int | None = None) -> int:
    found = body.find(token, start, None if at_most is None else start + at_most)
    if found < 0:
        raise _malformed("it ends before its last boundary")
    return found


def _malformed(what: str) -> RequestError:
    return RequestError(f"the body is no well-formed multipart/form-data: {what}; let an HTTP library build it")
