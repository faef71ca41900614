"""What goes past the framework, and what does not."""

from collections.abc import Callable

import httpx
import pytest
from fastapi import APIRouter, FastAPI
from starlette.requests import Request
from starlette.responses import Response

from service.errors import BusyError
from service.http.direct import DirectMiddleware
from service.http.request_id import RequestIdMiddleware
from service.runtime.tracing import Tracing

Told = list[tuple[str, str, str]]


@pytest.fixture
def told() -> Told:
    return []


@pytest.fixture
def client(told: Told, app_client: Callable[[FastAPI], httpx.Client]) -> httpx.Client:
    router, app = APIRouter(), FastAPI()

    @router.post("/v1/thing", operation_id="thing")
    async def thing(request: Request) -> Response:
        match await request.body():
            case b"busy":
                raise BusyError("full")
            case b"odd":
                raise ZeroDivisionError
            case body:
                return Response(body, headers={"Framework": "no" if "fastapi_astack" not in request.scope else "yes"})

    app.include_router(router)
    app.add_middleware(DirectMiddleware, router=router)

    def requested(face: str, method: str, code: str, seconds: float) -> None:
        assert seconds >= 0
        told.append((face, method, code))

    app.add_middleware(RequestIdMiddleware, requested=requested, tracing=Tracing())
    return app_client(app)


def test_the_endpoint_answers_without_the_framework_and_is_counted_by_its_name(
    client: httpx.Client, told: Told
) -> None:
    answer = client.post("/v1/thing", content=b"body")
    assert (answer.status_code, answer.content, answer.headers["framework"]) == (200, b"body", "no")
    assert answer.headers["x-request-id"]
    assert told == [("rest", "thing", "200")]


@pytest.mark.parametrize(("body", "status", "code"), [(b"busy", 503, "busy"), (b"odd", 500, "internal")])
def test_its_errors_are_problems(client: httpx.Client, told: Told, body: bytes, status: int, code: str) -> None:
    answer = client.post("/v1/thing", content=body)
    assert (answer.status_code, answer.json()["code"]) == (status, code)
    assert answer.json()["request_id"] == answer.headers["x-request-id"]
    assert told == [("rest", "thing", str(status))]


@pytest.mark.parametrize(
    ("ask", "status"),
    [
        (lambda client: client.get("/v1/thing"), 405),
        (lambda client: client.post("/v1/thing/"), 307),
        (lambda client: client.post("/v1/other"), 404),
        (lambda client: client.get("/openapi.json"), 200),
    ],
)
def test_everything_else_is_the_framework_s(client: httpx.Client, ask: Callable[..., Response], status: int) -> None:
    assert ask(client).status_code == status
