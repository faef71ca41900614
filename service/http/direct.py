"""The routes that carry pictures, without the framework's layers: their endpoints take a request and give a response themselves.

FastAPI still has them, for the contract; its dispatch, dependencies and validation cost more than everything else between a body
and a worker (decision log).
"""

from fastapi import APIRouter
from fastapi.routing import APIRoute
from starlette.requests import Request
from starlette.types import ASGIApp, Receive, Scope, Send

from service.errors import StreetfixError
from service.http.problems import problem_of, problem_response


class DirectMiddleware:
    """Innermost: everything else goes on to the framework.

    Args:
        app: the framework.
        router: whose endpoints take a request and nothing else.
    """

    def __init__(self, app: ASGIApp, router: APIRouter) -> None:
        self._app = app
        routes = [route for route in router.routes if isinstance(route, APIRoute)]
        self._routes = {(method, route.path): route for route in routes for method in route.methods or ()}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """One ASGI call."""
        route = self._routes.get((scope["method"], scope["path"])) if scope["type"] == "http" else None
        if route is None:
            await self._app(scope, receive, send)
            return
        scope["route"] = route  # whose name metrics and traces bear
        try:
            response = await route.endpoint(Request(scope, receive))
        except StreetfixError as error:
            response = problem_response(problem_of(error, scope["state"]["request_id"]))
        await response(scope, receive, send)
