"""HTTP/1.1 by httptools under uvicorn, with limits on everything but the body, because httptools has none.

httptools parses requests in C. For bodies of this size it takes a tenth of the time of h11 (decision log).
"""

import asyncio
import logging
from typing import Any

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol, RequestResponseCycle

_log = logging.getLogger("streetfix.http")

#: Limit for request line, headers, chunk sizes and trailers of one request. Bodies have their own limits.
HEAD_BYTES = 16 * 1024
#: The framing of a chunked body may take one part in this many of its size.
_FRAMES_SHARE = 8
#: Limit for requests that a client may send on one connection before the first is answered.
PIPELINED = 16
#: A refused request may be answered before its body has arrived. The server still reads ``UNWANTED_BYTES`` of it, for clients that read
#: only after they have sent everything. Then it stops reading. It closes the connection ``LINGER_SECONDS`` later, so that other clients
#: can read the answer.
UNWANTED_BYTES, LINGER_SECONDS = 2**20, 2.0
#: A new or kept connection that has not sent a complete head within this time is closed.
HEAD_SECONDS = 30.0


class BoundedHttp(HttpToolsProtocol):
    """uvicorn's httptools protocol with limits.

    A head that is too large gets status 400. If no complete head arrives in time, the connection is closed.

    Args:
        given: positional arguments of the base class.
        named: keyword arguments of the base class.
    """

    def __init__(self, *given: Any, **named: Any) -> None:
        super().__init__(*given, **named)
        self._in_head = False  # a head has begun and is not complete
        # Body bytes of all requests, body bytes of this request, other bytes of this request.
        self._bodies_bytes = self._body_bytes = self._other_bytes = 0
        self._head_timer: asyncio.TimerHandle | None = None
        self._unanswered: list[RequestResponseCycle] = []
        self._unwanted_bytes = 0

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]  # as uvicorn's own
        """Start the timer for the first head of a new connection.

        Args:
            transport: of the connection.
        """
        super().connection_made(transport)
        self._await_head()

    def connection_lost(self, exc: Exception | None) -> None:
        """Mark all unanswered requests of the connection as disconnected.

        Args:
            exc: why the connection was lost; None if it was closed.
        """
        self._head_came()
        super().connection_lost(exc)
        # uvicorn informs only the last request. uvloop raises if the others still send.
        for cycle in self._unanswered:
            cycle.disconnected = True
            cycle.message_event.set()

    def data_received(self, data: bytes) -> None:
        """Parse data, then count the bytes that were not part of a body.

        Args:
            data: as received.
        """
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
        """Reset the counters at the beginning of a request."""
        super().on_message_begin()
        self._in_head, self._body_bytes, self._other_bytes, self._unwanted_bytes = True, 0, 0, 0

    def on_headers_complete(self) -> None:
        """Accept a complete head.

        Raises:
            ValueError: too many requests were sent ahead.
        """
        if len(self.pipeline) >= PIPELINED:
            # httptools turns this into a parser error, which gets status 400.
            raise ValueError(
                f"more than {PIPELINED} pipelined requests; wait for responses, or open a further connection"
            )
        self._in_head = False
        self._head_came()
        super().on_headers_complete()
        self._unanswered = [cycle for cycle in (*self._unanswered, self.cycle) if not cycle.response_complete]

    def on_body(self, body: bytes) -> None:
        """Count a part of the body.

        Args:
            body: the part.
        """
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
            self.send_400_response("The request header is too large.")
        else:  # an answer may already be in transfer
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
