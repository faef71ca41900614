"""Refuse requests that a foreign web page caused a browser to send. This check runs before keys and routes."""

from collections.abc import Iterable

from starlette.types import ASGIApp, Receive, Scope, Send

from service.errors import ForbiddenHostError, ForbiddenOriginError, StreetfixError
from service.http.auth import OPEN
from service.http.problems import problem_of, problem_response
from service.runtime.hosts import AllowedHosts

#: Methods that change nothing and cost little. Browsers send no reliable ``Origin`` with them.
_SAFE = frozenset({"GET", "HEAD", "OPTIONS"})
_SHOWN = 80


class HostMiddleware:
    """ASGI middleware that checks ``Host`` of every request, and ``Origin`` of requests that may change something.

    A request without ``Origin`` passes. ``/livez`` and ``/readyz`` are open under every name, for orchestrators.

    Args:
        app: inner application.
        hosts: allowed names.
    """

    def __init__(self, app: ASGIApp, hosts: AllowedHosts) -> None:
        self._app = app
        self._hosts = hosts

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one ASGI call: pass it on, or answer with the problem."""
        if scope["type"] == "http" and scope["path"] not in OPEN:
            try:
                self._require(scope["method"], scope["headers"])
            except StreetfixError as error:
                await problem_response(problem_of(error, scope["state"]["request_id"]))(scope, receive, send)
                return
        await self._app(scope, receive, send)

    def _require(self, method: str, headers: Iterable[tuple[bytes, bytes]]) -> None:
        """Check both headers.

        Raises:
            ForbiddenHostError: there is not exactly one ``Host``, or it is not allowed.
            ForbiddenOriginError: the method is not safe, and a page of another origin sent the request.
        """
        hosts = [value.decode("latin-1") for name, value in headers if name == b"host"]
        if len(hosts) != 1 or not self._hosts.allows(hosts[0]):
            raise ForbiddenHostError(
                f"the header Host is {_shown(hosts)}, which is no name of this service; ask by its address or by localhost, or "
                "let its operator add the name to STREETFIX_ALLOWED_HOSTS"
            )
        origins = [value.decode("latin-1") for name, value in headers if name == b"origin"]
        if method in _SAFE or not origins:
            return
        if len(origins) > 1 or not self._hosts.allows_origin(origins[0], hosts[0]):
            raise ForbiddenOriginError(
                f"the header Origin is {_shown(origins)}, another origin than {_shown(hosts)}; send this from the service's own "
                "page or from a program, or let its operator add the page's host to STREETFIX_ALLOWED_HOSTS"
            )


def _shown(values: list[str]) -> str:
    return " and ".join(repr(each[:_SHOWN]) for each in values[:2]) or "missing"
