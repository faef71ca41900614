"""The memory budget of bodies and images, over REST."""

import asyncio
import gc
import json
import time
from collections.abc import AsyncIterator, Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import httpx
import numpy as np
import pytest
from fastapi import FastAPI

from service.http.app import create_app
from service.runtime.admission import MIB, MemoryBudget
from service.runtime.engine import Engine
from service.runtime.settings import Limits, Settings

AppClient = Callable[[FastAPI], httpx.Client]
Parts = Callable[..., dict[str, bytes]]


@pytest.fixture(scope="module")
def opened(bundle_path: Path) -> Iterator[Engine]:
    engine = Engine.open(
        Settings(maps=(bundle_path,), threads=1, limits=Limits(max_request_bytes=4 * MIB), request_timeout_s=5)
    )
    yield engine
    engine.close()


@pytest.fixture
def engine(opened: Engine) -> Engine:
    """The engine with a memory of the test's own."""
    opened.memory = MemoryBudget(8 * MIB)
    return opened


@pytest.fixture
def no_collector() -> Iterator[None]:
    """Disable the garbage collector: objects that survive have a reference."""
    gc.collect()
    gc.disable()
    yield
    gc.enable()


def freed(engine: Engine) -> bool:
    """Wait until memory is free: a worker frees its objects shortly after the caller has the answer."""
    until = time.monotonic() + 5
    while engine.memory.held:
        if time.monotonic() > until:
            return False
        time.sleep(0.01)
    return True


def post(client: httpx.Client, path: str, parts: dict[str, bytes]) -> httpx.Response:
    return client.post(path, files={name: (name, data) for name, data in parts.items()})


def numbered(parts: dict[str, bytes], document: dict[str, Any], count: int) -> dict[str, bytes]:
    pictures = {f"{name}{k}": parts[name] for k in range(count) for name in ("rgb", "depth")}
    return pictures | {"request": json.dumps(document).encode()}


@pytest.mark.parametrize("depth", [{}, {"scale_m": 0.001, "max_range_m": 0.01}], ids=["good", "no depth"])
@pytest.mark.parametrize("path", ["/v1/localize", "/v1/explain", "/v1/localize/sequence", "/v1/localize/batch"])
def test_all_is_given_back_after_an_answer_and_after_an_error(
    engine: Engine, app_client: AppClient, parts_of: Parts, no_collector: None, path: str, depth: dict[str, Any]
) -> None:
    parts = parts_of(**({"depth": depth} if depth else {}))
    one = json.loads(parts["request"])
    if path.endswith("sequence"):
        parts = numbered(parts, {"frames": [one]}, 1)
    elif path.endswith("batch"):
        parts = numbered(parts, {"requests": [one, one]}, 2)
    answer = post(app_client(create_app(engine)), path, parts)
    assert answer.status_code == (200 if not depth or path.endswith("batch") else 422), answer.text
    assert freed(engine)


def test_a_body_that_does_not_fit_is_refused_before_it_is_read(engine: Engine, app_client: AppClient) -> None:
    client = app_client(create_app(engine))
    with engine.memory.hold() as others:
        others.grow(6 * MIB)
        refused = client.post(
            "/v1/localize", content=bytes(3 * MIB), headers={"content-type": "multipart/form-data; boundary=b"}
        )
        assert (refused.status_code, refused.json()["code"], refused.headers["retry-after"]) == (503, "busy", "1")
        assert "memory for requests is full" in refused.json()["detail"]
    assert engine.memory.held == 0
    allowed = client.post(
        "/v1/localize", content=bytes(3 * MIB), headers={"content-type": "multipart/form-data; boundary=b"}
    )
    assert allowed.status_code == 422


def test_a_body_of_unknown_length_is_refused_where_it_no_longer_fits(engine: Engine) -> None:
    sent = 0

    async def chunks() -> AsyncIterator[bytes]:
        nonlocal sent
        for _ in range(100):
            sent += 1
            yield bytes(MIB // 8)

    async def ask() -> httpx.Response:
        transport = httpx.ASGITransport(create_app(engine))
        async with httpx.AsyncClient(transport=transport, base_url="http://localhost") as client:
            headers = {"content-type": "multipart/form-data; boundary=b"}
            return await client.post("/v1/localize", content=chunks(), headers=headers)

    with engine.memory.hold() as others:
        others.grow(6 * MIB + 1)
        refused = asyncio.run(ask())
    assert (refused.status_code, refused.json()["code"]) == (503, "busy")
    assert sent < 12
    assert engine.memory.held == 0


def test_pictures_are_weighed_by_their_pixels_before_they_are_decoded(
    engine: Engine, app_client: AppClient, parts_of: Parts, monkeypatch: pytest.MonkeyPatch
) -> None:
    client = app_client(create_app(engine))
    camera = {"width": 1200, "height": 900, "fx": 600, "fy": 600, "cx": 599.5, "cy": 449.5}
    rgb = cv2.imencode(".png", np.zeros((900, 1200, 3), np.uint8))[1].tobytes()
    parts = parts_of(camera=camera) | {"rgb": rgb}
    assert len(rgb) < 10_000

    def never(*_: object, **__: object) -> None:
        raise AssertionError("it was decoded")

    monkeypatch.setattr("service.imaging.decode.opencv_decode", never)
    alone = post(client, "/v1/localize", parts)
    assert (alone.status_code, alone.json()["code"]) == (413, "too-large")
    assert "STREETFIX_REQUEST_MEMORY_MIB" in alone.json()["detail"]
    engine.memory = MemoryBudget(16 * MIB)
    with engine.memory.hold() as others:
        others.grow(8 * MIB)
        beside = post(client, "/v1/localize", parts)
    assert (beside.status_code, beside.json()["code"]) == (503, "busy")
    assert freed(engine)


def test_a_sequence_is_weighed_as_a_whole(engine: Engine, app_client: AppClient, parts_of: Parts) -> None:
    """Each frame fits the budget alone. All frames stay in memory until the answer."""
    client = app_client(create_app(engine))
    camera = {"width": 400, "height": 300, "fx": 200, "fy": 200, "cx": 199.5, "cy": 149.5}
    rgb = cv2.imencode(".png", np.zeros((300, 400, 3), np.uint8))[1].tobytes()
    depth = cv2.imencode(".png", np.random.default_rng(0).integers(4000, 9000, (300, 400), np.uint16))[1].tobytes()
    frame = {"camera": camera}
    moved = {"position": {"x": 0, "y": 0, "z": 0.1}, "orientation": {"x": 0, "y": 0, "z": 0, "w": 1}}
    frames = [frame | ({"T_reference_camera": moved} if number else {}) for number in range(8)]
    parts = numbered(parts_of() | {"rgb": rgb, "depth": depth}, {"frames": frames}, 8)
    assert post(client, "/v1/localize/sequence", parts).status_code == 503
    assert freed(engine)
    engine.memory = MemoryBudget(24 * MIB)
    assert post(client, "/v1/localize/sequence", parts).status_code == 200
    assert freed(engine)


def test_operators_see_what_is_reserved(bundle_path: Path) -> None:
    engine = Engine.open(Settings(maps=(bundle_path,), threads=1, request_memory_mib=200))
    try:
        with engine.memory.hold() as hold:
            hold.grow(3 * MIB)
            told = engine.metrics.text().decode()
    finally:
        engine.close()
    figures = dict(line.split() for line in told.splitlines() if line.startswith("streetfix_request_memory"))
    assert {name: float(value) / MIB for name, value in figures.items()} == {
        "streetfix_request_memory_bytes": 3,
        "streetfix_request_memory_limit_bytes": 200,
    }
