"""The outermost middleware: gives every request an id and answers unexpected errors."""

import re
import uuid
from collections.abc import Callable
from http import HTTPStatus
from time import perf_counter

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.http.problems import internal_error
from service.runtime.logs import log_request
from service.runtime.tracing import Tracing

HEADER = "X-Request-Id"
#: Status in metrics and log if the client disconnects before the answer, as nginx uses it.
_CLIENT_CLOSED = 499
_ACCEPTABLE = re.compile(r"[A-Za-z0-9._-]{1,64}")


class RequestIdMiddleware:
    """ASGI middleware for request ids, unexpected errors (status 500), metrics, spans and the log.

    It keeps the ``X-Request-Id`` of the caller if it is 1 to 64 letters, digits, ``.``, ``_`` or ``-``; else it creates one.

    Args:
        app: inner application.
        requested: called with request handler, operation, status and seconds of every request.
        tracing: creates the spans.
    """

    def __init__(self, app: ASGIApp, requested: Callable[[str, str, str, float], None], tracing: Tracing) -> None:
        self._app = app
        self._requested = requested
        self._tracing = tracing

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one ASGI call."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        given = headers.get(HEADER, "")
        request_id = given if _ACCEPTABLE.fullmatch(given) else uuid.uuid4().hex
        scope.setdefault("state", {})["request_id"] = request_id
        span = scope["state"]["span"] = self._tracing.begin("rest", headers.get("traceparent"))
        started, began, status = False, perf_counter(), 0

        async def send_with_id(message: Message) -> None:
            nonlocal started, status
            if message["type"] == "http.response.start":
                started, status = True, message["status"]
                MutableHeaders(scope=message)[HEADER] = request_id
            await send(message)

        try:
            await self._app(scope, receive, send_with_id)
        except ClientDisconnect:
            status = _CLIENT_CLOSED
        except Exception as error:
            response = internal_error(error, request_id)
            if started:
                raise
            await response(scope, receive, send_with_id)
        finally:
            operation = getattr(scope.get("route"), "operation_id", None) or "none"
            seconds = perf_counter() - began
            self._requested("rest", operation, str(status), seconds)
            span.end(operation, str(status), failed=status >= HTTPStatus.INTERNAL_SERVER_ERROR)
            log_request(
                face="rest", method=operation, code=str(status), seconds=seconds, request_id=request_id,
                traceparent=headers.get("traceparent"),
            )  # fmt: skip
