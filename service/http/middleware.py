"""What every request passes before its route: id and log, check of the host, check of the key.

``create_app`` nests the classes in the order of this file, ``RequestIdMiddleware`` outermost. No check reads the body.
"""

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from http import HTTPStatus
from ipaddress import ip_address
from time import perf_counter

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import ClientDisconnect, Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.contract.schema import REQUEST_ID, request_id_of
from service.errors import ForbiddenError, ForbiddenHostError, ForbiddenOriginError, StreetfixError, UnauthorizedError
from service.http.problems import internal_error, problem_of, problem_response
from service.runtime.keys import Caller, KeyRing, presented_key
from service.runtime.logs import log_request
from service.runtime.settings import Settings, is_loopback
from service.runtime.tracing import NO_SPAN, Tracing

#: Status in metrics and log if the client disconnects before the answer, as nginx uses it.
_CLIENT_CLOSED = 499

#: Paths for an orchestrator. It has no key and uses any host name.
_OPEN = frozenset({"/livez", "/readyz"})
#: The page of the console is public and holds no map data. It requests its data with a key.
_PAGE = "/console"

#: Methods that change nothing and cost little. Browsers send no reliable ``Origin`` with them.
_SAFE = frozenset({"GET", "HEAD", "OPTIONS"})
_AUTHORITY = re.compile(r"(?P<host>\[[0-9a-f:.]+\]|[^\[\]:@/?#\\]+)(:(?P<port>[0-9]{1,5}))?")
_DEFAULT_PORTS = {"http": "80", "https": "443"}
_ANY = "*"
_SHOWN = 80


class RequestIdMiddleware:
    """ASGI middleware for request ids, unexpected errors (status 500), metrics, spans and the log.

    It keeps the ``X-Request-Id`` of the caller if it is 1 to 64 letters, digits, ``.``, ``_`` or ``-``; else it creates one.

    Args:
        app: inner application.
        requested: called with request handler, operation, status and seconds of every request.
        tracing: creates the spans; None traces nothing.
    """

    def __init__(
        self, app: ASGIApp, requested: Callable[[str, str, str, float], None], tracing: Tracing | None
    ) -> None:
        self._app = app
        self._requested = requested
        self._tracing = tracing

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one ASGI call. ``state`` gets the request id and the span."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        request_id = request_id_of(headers.get(REQUEST_ID, ""))
        span = NO_SPAN if self._tracing is None else self._tracing.begin("rest", headers.get("traceparent"))
        scope.setdefault("state", {}).update(request_id=request_id, span=span)
        started, began, status = False, perf_counter(), 0

        async def send_with_id(message: Message) -> None:
            nonlocal started, status
            if message["type"] == "http.response.start":
                started, status = True, message["status"]
                MutableHeaders(scope=message)[REQUEST_ID] = request_id
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
                face="rest",
                method=operation,
                code=str(status),
                seconds=seconds,
                request_id=request_id,
                traceparent=headers.get("traceparent"),
            )


@dataclass(frozen=True, slots=True)
class Authority:
    """Host and port of a ``Host`` header or an origin.

    Attributes:
        host: name or address, lower case, without brackets.
        port: digits; empty if none is given.
    """

    host: str
    port: str

    @classmethod
    def read(cls, text: str) -> "Authority | None":
        """Parse ``name:port``; None if the text is not valid.

        Args:
            text: value of the header.
        """
        found = _AUTHORITY.fullmatch(text.lower())
        if found is None:
            return None
        return cls(found["host"].strip("[]").rstrip("."), found["port"] or "")


@dataclass(frozen=True, slots=True)
class AllowedHosts:
    """Host names that a service accepts.

    This protects against DNS rebinding: an attacker points the name of a web page to this machine. For a browser the page then has
    the same origin as the service. Only the name in ``Host`` reveals the attack. An address cannot be rebound; an unknown name can.

    Attributes:
        names: listed by the operator; exact names, or ``*.name`` for all names below.
        own: name that the service listens on; empty if it is an address.
        any_name: accept every name.
    """

    names: tuple[str, ...]
    own: str
    any_name: bool

    @classmethod
    def of(cls, settings: Settings) -> "AllowedHosts":
        """Take the names of the settings.

        Without listed names every name is allowed if all requests need a key or a client certificate. Rebinding then gains nothing:
        a page in a browser has no key, and TLS with the name of an attacker fails. The service cannot know its own public names.

        Args:
            settings: of the service.
        """
        guarded = settings.api_keys is not None or settings.tls_client_ca is not None
        own = "" if _is_address(settings.host) else settings.host.lower().rstrip(".")
        listed = tuple(each for each in settings.allowed_hosts if each != _ANY)
        return cls(listed, own, _ANY in settings.allowed_hosts or (guarded and not settings.allowed_hosts))

    def allows(self, host: str) -> bool:
        """Return whether a ``Host`` header names this service: an address, a loopback name, or an allowed name.

        Args:
            host: value of the header.
        """
        authority = Authority.read(host)
        if authority is None:
            return False
        name = authority.host
        return (
            self.any_name
            or _is_address(name)
            or name == "localhost"
            or name.endswith(".localhost")
            or name == self.own
            or self._lists(name)
        )

    def allows_origin(self, origin: str, host: str) -> bool:
        """Return whether a page may change something: its origin is the service itself or a listed name.

        Args:
            origin: value of the header ``Origin``; ``null`` is refused.
            host: value of the header ``Host`` of the same request.
        """
        scheme, _, rest = origin.partition("://")
        source, own = Authority.read(rest), Authority.read(host)
        if scheme.lower() not in _DEFAULT_PORTS or source is None or own is None:
            return False
        default = _DEFAULT_PORTS[scheme.lower()]
        same = source.host == own.host and (source.port or default) == (own.port or default)
        return same or self._lists(source.host)

    def _lists(self, name: str) -> bool:
        return any(name.endswith(each[1:]) if each.startswith("*.") else name == each for each in self.names)


class HostMiddleware:
    """ASGI middleware that checks ``Host`` of every request, and ``Origin`` of requests that may change something.

    It refuses requests that a foreign web page caused a browser to send. A request without ``Origin`` passes. ``/livez`` and
    ``/readyz`` are open under every name, for orchestrators.

    Args:
        app: inner application.
        hosts: allowed names.
    """

    def __init__(self, app: ASGIApp, hosts: AllowedHosts) -> None:
        self._app = app
        self._hosts = hosts

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one ASGI call: pass it on, or answer with the problem."""
        if scope["type"] == "http" and scope["path"] not in _OPEN:
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
                f"the header Host is {_shown(hosts)}, which is not allowed; use an IP address or localhost, or let the operator "
                "add the name to STREETFIX_ALLOWED_HOSTS"
            )
        origins = [value.decode("latin-1") for name, value in headers if name == b"origin"]
        if method in _SAFE or not origins:
            return
        if len(origins) > 1 or not self._hosts.allows_origin(origins[0], hosts[0]):
            raise ForbiddenOriginError(
                f"the header Origin is {_shown(origins)}, but the host is {_shown(hosts)}; send the request from the service's own "
                "page or from a program, or let the operator add the host of the page to STREETFIX_ALLOWED_HOSTS"
            )


class AuthMiddleware:
    """ASGI middleware that requires a key. An application without keys does not have it.

    Args:
        app: inner application.
        keys: of the callers.
    """

    def __init__(self, app: ASGIApp, keys: KeyRing) -> None:
        self._app = app
        self._keys = keys

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one ASGI call: store the caller in ``state``, or answer with the problem."""
        if scope["type"] == "http" and not _needs_no_key(scope["path"]):
            headers = Headers(scope=scope)
            try:
                presented = presented_key(headers.get("authorization"), headers.get("x-api-key"))
                scope["state"]["caller"] = self._keys.require(presented)
            except UnauthorizedError as error:
                problem = problem_of(error, scope["state"]["request_id"])
                await problem_response(problem, {"WWW-Authenticate": "Bearer"})(scope, receive, send)
                return
        await self._app(scope, receive, send)


def require_operator(request: Request, settings: Settings) -> None:
    """Require that the caller is an operator.

    Args:
        request: of the caller.
        settings: of the service.

    Raises:
        ForbiddenError: the key does not belong to an operator; or there are no keys and other machines can reach the service.
    """
    caller: Caller | None = getattr(request.state, "caller", None)
    allowed = is_loopback(settings.host) if caller is None else caller.operator
    if not allowed:
        raise ForbiddenError("this request needs operator rights; use a key made with streetfix keys --operator")


def _needs_no_key(path: str) -> bool:
    return path in _OPEN or path in ("/", "/docs", _PAGE) or path.startswith(f"{_PAGE}/")


def _is_address(text: str) -> bool:
    try:
        ip_address(text)
    except ValueError:
        return False
    return True


def _shown(values: list[str]) -> str:
    return " and ".join(repr(each[:_SHOWN]) for each in values[:2]) or "missing"
