import asyncio
from collections.abc import Callable, Iterator
from pathlib import Path

import httpx
import pytest
from fastapi import FastAPI

from service.http.app import create_app
from service.runtime.engine import Engine
from service.runtime.settings import Limits, Settings


class AppTransport(httpx.BaseTransport):
    """Calls an application without a socket, so a plain httpx.Client can use it."""

    def __init__(self, app: FastAPI) -> None:
        self._transport = httpx.ASGITransport(app, raise_app_exceptions=False)

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        stream = httpx.ByteStream(request.read())
        asynchronous = httpx.Request(request.method, request.url, headers=request.headers, stream=stream)

        async def call() -> httpx.Response:
            response = await self._transport.handle_async_request(asynchronous)
            raw = b"".join([chunk async for chunk in response.aiter_raw()])  # the outer client decodes it
            return httpx.Response(response.status_code, headers=response.headers, content=raw)

        return asyncio.run(call())


@pytest.fixture(scope="session")
def app_client() -> Callable[[FastAPI], httpx.Client]:
    """Return a client of an application."""
    return lambda app: httpx.Client(transport=AppTransport(app), base_url="http://127.0.0.1")


@pytest.fixture(scope="session")
def client_of() -> Callable[[Engine], httpx.Client]:
    return lambda engine: httpx.Client(transport=AppTransport(create_app(engine)), base_url="http://127.0.0.1")


@pytest.fixture(scope="module")
def engine(bundle_path: Path) -> Iterator[Engine]:
    limits = Limits(max_request_bytes=200_000, max_part_bytes=150_000, max_pixels=10_000)
    engine = Engine.open(Settings(maps=(bundle_path,), threads=1, queue=1, limits=limits))
    yield engine
    engine.close()


@pytest.fixture(scope="module")
def client(engine: Engine, client_of: Callable[[Engine], httpx.Client]) -> httpx.Client:
    return client_of(engine)
