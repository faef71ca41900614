"""Asks for an API key before a byte of a body is read."""

from starlette.datastructures import Headers
from starlette.requests import Request
from starlette.types import ASGIApp, Receive, Scope, Send

from service.errors import ForbiddenError, UnauthorizedError
from service.http.problems import problem_of, problem_response
from service.runtime.keys import Caller, KeyRing, presented_key
from service.runtime.settings import Settings, is_loopback

#: What an orchestrator asks, which has no key.
OPEN = frozenset({"/livez", "/readyz"})
#: The console's page is the same for everybody and says nothing of a map; what it shows it asks for with a key.
_PAGE = "/console"


def needs_no_key(path: str) -> bool:
    """Whether anybody may ask for a path."""
    return path in OPEN or path in ("/", "/docs", _PAGE) or path.startswith(f"{_PAGE}/")


def require_operator(request: Request, settings: Settings) -> None:
    """Let only those change what a service does who may.

    Raises:
        ForbiddenError: the caller's key is no operator's; or there are no keys, and others than this machine's users can ask.
    """
    caller: Caller | None = getattr(request.state, "caller", None)
    allowed = is_loopback(settings.host) if caller is None else caller.operator
    if not allowed:
        raise ForbiddenError("this is for operators: use a key that streetfix keys --operator made")


class AuthMiddleware:
    """Inside of the request id, outside of everything else."""

    def __init__(self, app: ASGIApp, keys: KeyRing) -> None:
        self._app = app
        self._keys = keys

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """One ASGI call."""
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
