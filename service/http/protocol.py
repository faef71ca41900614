"""HTTP/1.1 by httptools under uvicorn, with bounds on what is not a body: httptools itself has none.

httptools splits requests in C, which costs a tenth of what h11 costs for bodies of this size (decision log).
"""

import asyncio
import logging
from typing import Any

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol, RequestResponseCycle

_log = logging.getLogger("streetfix.http")

#: Request line, headers, chunk sizes and trailers of one request; bodies have limits of their own.
HEAD_BYTES = 16 * 1024
#: A chunked body's frames may cost so much of it again.
_FRAMES_SHARE = 8
#: Requests that a caller may send ahead on one connection before the first is answered.
PIPELINED = 16
#: Of a body that was answered before it was here, as refused ones are, so much is still read, for clients that read when they have
#: sent all. Then nothing is read any more, and a moment later, in which others can read the answer, the connection is closed.
UNWANTED_BYTES, LINGER_SECONDS = 2**20, 2.0
#: A connection that has not sent a whole head by then is closed, be it new or kept.
HEAD_SECONDS = 30.0


class BoundedHttp(HttpToolsProtocol):
    """uvicorn's protocol on httptools; a head that is too large gets 400, one that does not come ends the connection."""

    def __init__(self, *given: Any, **named: Any) -> None:
        super().__init__(*given, **named)
        self._in_head = False  # it has begun and is not here as a whole
        self._bodies_bytes = self._body_bytes = self._other_bytes = 0  # of all requests, and of this one
        self._head_timer: asyncio.TimerHandle | None = None
        self._unanswered: list[RequestResponseCycle] = []
        self._unwanted_bytes = 0

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]  # as uvicorn's own
        """A caller has come and must say something."""
        super().connection_made(transport)
        self._await_head()

    def connection_lost(self, exc: Exception | None) -> None:
        """The caller has gone."""
        self._head_came()
        super().connection_lost(exc)
        # uvicorn tells the last one only, and uvloop refuses what the others would still send.
        for cycle in self._unanswered:
            cycle.disconnected = True
            cycle.message_event.set()

    def data_received(self, data: bytes) -> None:
        """Parse, then count what was no body."""
        before = self._bodies_bytes
        super().data_received(data)
        if self.transport.is_closing():
            return
        self._other_bytes += len(data) - (self._bodies_bytes - before)
        if self._other_bytes > HEAD_BYTES + self._body_bytes // _FRAMES_SHARE:
            self._refuse()
        elif self._in_head and self._head_timer is None:
            self._await_head()

    def on_message_begin(self) -> None:
        """A request begins."""
        super().on_message_begin()
        self._in_head, self._body_bytes, self._other_bytes, self._unwanted_bytes = True, 0, 0, 0

    def on_headers_complete(self) -> None:
        """Its head is here."""
        if len(self.pipeline) >= PIPELINED:
            # httptools makes it an error of the parser, which is answered 400.
            raise ValueError(f"more than {PIPELINED} requests sent ahead")
        self._in_head = False
        self._head_came()
        super().on_headers_complete()
        self._unanswered = [cycle for cycle in (*self._unanswered, self.cycle) if not cycle.response_complete]

    def on_body(self, body: bytes) -> None:
        """A piece of its body."""
        self._bodies_bytes += len(body)
        self._body_bytes += len(body)
        if self.cycle is not None and self.cycle.response_complete:
            self._discard(len(body))
        super().on_body(body)

    def _discard(self, count: int) -> None:
        before, self._unwanted_bytes = self._unwanted_bytes, self._unwanted_bytes + count
        if before <= UNWANTED_BYTES < self._unwanted_bytes:
            self.flow.pause_reading()
            asyncio.get_running_loop().call_later(LINGER_SECONDS, self.transport.close)

    def _refuse(self) -> None:
        _log.info("head_too_large")
        if self.cycle is None or self.cycle.response_complete:
            self.send_400_response("The head of the request is too large.")
        else:  # an answer may be under way
            self.transport.close()

    def _await_head(self) -> None:
        self._head_timer = asyncio.get_running_loop().call_later(HEAD_SECONDS, self._head_did_not_come)

    def _head_came(self) -> None:
        if self._head_timer is not None:
            self._head_timer.cancel()
            self._head_timer = None

    def _head_did_not_come(self) -> None:
        self._head_timer = None
        if self.cycle is None or self.cycle.response_complete:
            self.transport.close()
