"""Every route is declared once, and its responses match the declaration."""

from collections.abc import Callable
from functools import partial

import httpx
import pytest
from fastapi import APIRouter, Depends, FastAPI

from service.errors import BusyError, ForbiddenError
from service.http.app import create_app
from service.http.body import RequestRunner
from service.http.routes import localize
from service.runtime.engine import Engine

AppClient = Callable[[FastAPI], httpx.Client]
Parts = Callable[..., dict[str, bytes]]
PATHS = ("/v1/localize", "/v1/localize/sequence", "/v1/localize/batch")


def refuse() -> None:
    raise ForbiddenError("the guard says no")


@pytest.mark.parametrize("path", PATHS)
def test_a_dependency_of_a_localizing_route_is_honoured(
    engine: Engine, app_client: AppClient, parts_of: Parts, monkeypatch: pytest.MonkeyPatch, path: str
) -> None:
    files = {name: (name, data) for name, data in parts_of().items()}
    assert app_client(create_app(engine)).post(path, files=files).status_code != 403
    monkeypatch.setattr(localize, "APIRouter", partial(APIRouter, dependencies=[Depends(refuse)]))
    refused = app_client(create_app(engine)).post(path, files=files)
    assert (refused.status_code, refused.json()["code"]) == (403, "forbidden")


@pytest.mark.parametrize(
    ("error", "status", "code"), [(BusyError("full"), 503, "busy"), (ZeroDivisionError(), 500, "internal")]
)
def test_an_error_of_a_localizing_route_is_a_problem_and_is_counted_by_name(
    engine: Engine, app_client: AppClient, monkeypatch: pytest.MonkeyPatch, error: Exception, status: int, code: str
) -> None:
    async def fails(*_: object) -> None:
        raise error

    monkeypatch.setattr(RequestRunner, "__call__", fails)
    before = count(engine, status)
    answer = app_client(create_app(engine)).post("/v1/localize", content=b"x")
    assert (answer.status_code, answer.json()["code"]) == (status, code)
    assert answer.json()["request_id"] == answer.headers["x-request-id"]
    assert count(engine, status) == before + 1


def count(engine: Engine, status: int) -> float:
    name = f'streetfix_requests_total{{code="{status}",face="rest",method="localize"}} '
    lines = engine.metrics.text().decode().splitlines()
    return sum(float(line.removeprefix(name)) for line in lines if line.startswith(name))
