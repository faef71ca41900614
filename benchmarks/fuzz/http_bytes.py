"""Arbitrary bytes of a connection, passed to the HTTP protocol handler without a socket."""

import asyncio
import weakref
from typing import Any, cast

import httptools
import uvicorn
from uvicorn.server import ServerState

from service.http.protocol import HEAD_BYTES, PIPELINED, BoundedHttp

_BODY = b"a=1&" * 40
#: Valid requests, and two beyond the limits. The first byte gives the size of the pieces that the connection delivers.
SEEDS = (
    b"\x00GET /livez HTTP/1.1\r\nHost: localhost\r\nAccept: */*\r\n\r\n",
    b"\x09POST /v1/localize?a=%%41 HTTP/1.1\r\nHost: localhost\r\nContent-Length: %d\r\nExpect: 100-continue\r\n\r\n%s"
    % (len(_BODY), _BODY),
    b"\x05POST / HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\n5\r\nabcde\r\n1;x=y\r\nf\r\n0\r\nX-T: 1\r\n\r\n",
    b"\x00" + 3 * b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n",
    b"\x00" + 2 * PIPELINED * b"GET / HTTP/1.1\r\n\r\n",
    b"\xffGET / HTTP/1.1\r\n" + HEAD_BYTES // 64 * (b"X-A: " + 90 * b"a" + b"\r\n"),
    b"\x20GET / HTTP/1.0\r\nConnection: upgrade\r\nUpgrade: websocket\r\n\r\n",
)
#: Turns of the event loop, far more than an application needs that waits for nothing.
_SETTLED = 40


class Wire(asyncio.Transport):
    """Connection that keeps the bytes written to it."""

    def __init__(self) -> None:
        super().__init__({"peername": ("127.0.0.1", 1), "sockname": ("127.0.0.1", 2)})
        self.written, self.closed = bytearray(), False

    def write(self, data: Any) -> None:
        """Keep bytes.

        Args:
            data: bytes that the service writes.

        Raises:
            AssertionError: the service writes after it closed the connection.
        """
        if self.closed:
            raise AssertionError("written after the close")
        self.written += data

    def close(self) -> None:
        """Record that the service closed the connection."""
        self.closed = True

    def is_closing(self) -> bool:
        """Return whether the connection is closed."""
        return self.closed

    def pause_reading(self) -> None:
        """Ignore the request: bytes still arrive, as from the worst caller."""

    def resume_reading(self) -> None:
        """Do nothing, since reading never pauses."""


class Connections:
    """Event loop that treats each input as all bytes of one caller before it hangs up."""

    def __init__(self) -> None:
        self._wrong = wrong = list[dict[str, Any]]()
        self._loop = asyncio.new_event_loop()
        self._loop.set_exception_handler(lambda _, context: wrong.append(context))
        weakref.finalize(self, self._loop.close)
        self._config = uvicorn.Config(
            _length_of_body, http=BoundedHttp, ws="none", lifespan="off", log_level="critical"
        )
        self._config.load()

    def take(self, data: bytes) -> None:
        """Run one connection.

        Args:
            data: the first byte is the size of the pieces, the rest is sent.

        Raises:
            AssertionError: an answer is not HTTP, the service holds more than the limits allow, or work continues after
                the caller has gone.
        """
        if data:
            self._loop.run_until_complete(self._connection(data[0], data[1:]))
        if self._wrong:
            raise AssertionError(self._wrong.pop())

    async def _connection(self, step: int, data: bytes) -> None:
        state, wire = ServerState(), Wire()
        protocol = BoundedHttp(self._config, state, {}, self._loop)
        protocol.connection_made(wire)
        for at in range(0, len(data), step or max(len(data), 1)):
            piece = data[at : at + (step or len(data))]
            protocol.data_received(piece)
            await asyncio.sleep(0)
            if wire.closed:
                break
            held = sum(len(name) + len(value) for name, value in protocol.headers or ())
            if held > HEAD_BYTES + len(piece) or len(protocol.pipeline) > PIPELINED:
                raise AssertionError(f"{held} bytes of headers and {len(protocol.pipeline)} requests are held")
        await _until(lambda: not _answering(protocol))
        protocol.connection_lost(None)
        await _until(lambda: not state.tasks)
        if state.tasks or state.connections:
            raise AssertionError("the request is still processed after the caller disconnected")
        _require_answers(bytes(wire.written))


def _answering(protocol: BoundedHttp) -> bool:
    """Return whether a request is complete and its answer is not."""
    cycle = protocol.cycle
    return bool(cycle is not None and not cycle.more_body and not cycle.response_complete)


async def _until(settled: Any) -> None:
    for _ in range(_SETTLED):
        if settled():
            return
        await asyncio.sleep(0)


class _Codes:
    """Status codes that httptools parses."""

    def __init__(self) -> None:
        self.parser: Any = None
        self.codes: list[int] = []

    def on_message_complete(self) -> None:
        self.codes.append(self.parser.get_status_code())


def _require_answers(written: bytes) -> None:
    """Require that the service wrote HTTP with expected status codes only."""
    found = _Codes()
    found.parser = httptools.HttpResponseParser(found)
    if written:
        found.parser.feed_data(written)
    if unknown := set(found.codes) - {100, 200, 400}:
        raise AssertionError(f"answers {unknown}")


async def _length_of_body(scope: Any, receive: Any, send: Any) -> None:
    """An application that reads the whole body and returns its length."""
    length, message = 0, cast("dict[str, Any]", {"more_body": True})
    while message.get("more_body"):
        message = await receive()
        if message["type"] == "http.disconnect":
            return
        length += len(message["body"])
    await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", b"8")]})
    await send({"type": "http.response.body", "body": b"" if scope["method"] == "HEAD" else b"%8d" % length})
