"""Check the API key before a byte of the body is read."""

from starlette.datastructures import Headers
from starlette.requests import Request
from starlette.types import ASGIApp, Receive, Scope, Send

from service.errors import ForbiddenError, UnauthorizedError
from service.http.problems import problem_of, problem_response
from service.runtime.keys import Caller, KeyRing, presented_key
from service.runtime.settings import Settings, is_loopback

#: Paths for an orchestrator, which has no key.
OPEN = frozenset({"/livez", "/readyz"})
#: The page of the console is public and holds no map data. It requests its data with a key.
_PAGE = "/console"


def needs_no_key(path: str) -> bool:
    """Return whether a path is open without a key.

    Args:
        path: of the request.
    """
    return path in OPEN or path in ("/", "/docs", _PAGE) or path.startswith(f"{_PAGE}/")


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
        raise ForbiddenError("this is for operators: use a key that streetfix keys --operator made")


class AuthMiddleware:
    """ASGI middleware that requires a key. It runs inside ``RequestIdMiddleware`` and ``HostMiddleware``, outside of the routes.

    Args:
        app: inner application.
        keys: of the callers.
    """

    def __init__(self, app: ASGIApp, keys: KeyRing) -> None:
        self._app = app
        self._keys = keys

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one ASGI call: store the caller in ``state``, or answer with the problem."""
        if scope["type"] == "http" and not needs_no_key(scope["path"]):
            headers = Headers(scope=scope)
            try:
                presented = presented_key(headers.get("authorization"), headers.get("x-api-key"))
                scope["state"]["caller"] = self._keys.require(presented)
            except UnauthorizedError as error:
                problem = problem_of(error, scope["state"]["request_id"])
                await problem_response(problem, {"WWW-Authenticate": "Bearer"})(scope, receive, send)
                return
        await self._app(scope, receive, send)
