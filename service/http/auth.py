"""Asks for an API key before a byte of a body is read."""

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

from service.errors import UnauthorizedError
from service.http.problems import problem_of, problem_response
from service.runtime.keys import KeyRing, presented_key

#: What an orchestrator asks, which has no key.
OPEN = frozenset({"/livez", "/readyz"})


class AuthMiddleware:
    """Inside of the request id, outside of everything else."""

    def __init__(self, app: ASGIApp, keys: KeyRing) -> None:
        self._app = app
        self._keys = keys

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """One ASGI call."""
        if scope["type"] == "http" and scope["path"] not in OPEN:
            headers = Headers(scope=scope)
            try:
                self._keys.require(presented_key(headers.get("authorization"), headers.get("x-api-key")))
            except UnauthorizedError as error:
                problem = problem_of(error, scope["state"]["request_id"])
                await problem_response(problem, {"WWW-Authenticate": "Bearer"})(scope, receive, send)
                return
        await self._app(scope, receive, send)
