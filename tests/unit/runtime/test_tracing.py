"""Trace spans as a collector receives them."""

import asyncio
import itertools
import sys
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter

from service.errors import ExtraMissingError
from service.http.app import create_app
from service.localization.answer import Timings
from service.runtime.engine import Engine
from service.runtime.settings import Settings
from service.runtime.tracing import NO_SPAN, Tracing

TRACE, PARENT = "0af7651916cd43dd8448eb211c80319c", "b7ad6b7169203331"
STAGES = ["decode", "fuse", "encode", "search", "register"]
Parts = Callable[..., dict[str, bytes]]
Ask = Callable[[httpx.AsyncClient], Awaitable[httpx.Response]]


@pytest.fixture
def engine(bundle_path: Path) -> Iterator[Engine]:
    engine = Engine.open(Settings(maps=(bundle_path,), threads=1))
    yield engine
    engine.close()


def spans(engine: Engine, ask: Ask, *, share: float = 1.0):
    exporter = InMemorySpanExporter()
    engine.tracing = Tracing.open("http://nowhere", share=share, exporter=exporter)

    async def run() -> None:
        transport = httpx.ASGITransport(create_app(engine), raise_app_exceptions=False)
        async with httpx.AsyncClient(transport=transport, base_url="http://localhost") as client:
            await ask(client)

    asyncio.run(run())
    tracer: Any = engine.tracing._tracer
    tracer.span_processor.force_flush()
    return list(exporter.get_finished_spans())


def localize(parts: dict[str, bytes], flags: str = "01") -> Ask:
    files = {name: (name, data) for name, data in parts.items()}
    headers = {"traceparent": f"00-{TRACE}-{PARENT}-{flags}"}
    return lambda client: client.post("/v1/localize", files=files, headers=headers)


def test_a_request_has_a_span_under_its_callers_and_stages_under_its_own(engine: Engine, parts_of: Parts) -> None:
    found = {each.name: each for each in spans(engine, localize(parts_of()))}
    assert list(found) == [*STAGES, "localize"]
    request = found["localize"]
    assert f"{request.context.trace_id:032x}" == TRACE
    assert f"{request.parent.span_id:016x}" == PARENT
    assert dict(request.attributes) == {"streetfix.face": "rest", "streetfix.code": "200"}
    assert all(found[name].parent.span_id == request.context.span_id for name in STAGES)
    for earlier, later in itertools.pairwise(STAGES):
        assert found[earlier].end_time == found[later].start_time
    assert request.start_time <= found["decode"].start_time
    assert found["register"].end_time <= request.end_time


def test_the_caller_says_whether_its_request_is_traced(engine: Engine, parts_of: Parts) -> None:
    assert spans(engine, localize(parts_of(), flags="00"), share=1.0) == []
    assert len(spans(engine, localize(parts_of(), flags="01"), share=0.0)) == 6


@pytest.mark.parametrize(("share", "count"), [(0.0, 0), (1.0, 1)])
def test_a_request_of_no_trace_is_traced_by_share(engine: Engine, share: float, count: int) -> None:
    assert len(spans(engine, lambda client: client.get("/livez"), share=share)) == count


def test_failures_are_marked_and_refusals_are_not(engine: Engine, parts_of: Parts) -> None:
    (refused,) = spans(engine, localize({"rgb": b"x"}))
    assert (refused.attributes["streetfix.code"], refused.status.is_ok) == ("422", True)
    engine.admission.submit = None  # type: ignore[method-assign,assignment]  # so that it raises what nobody foresaw
    (failed,) = spans(engine, localize(parts_of()))
    assert (failed.attributes["streetfix.code"], failed.status.is_ok) == ("500", False)


def test_without_an_endpoint_nothing_is_traced_and_nothing_is_imported(
    engine: Engine, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert engine.tracing is None
    # For no longer than that: pytest itself imports between the steps of a test, from Python 3.13 on.
    with monkeypatch.context() as without_imports:
        without_imports.setattr("builtins.__import__", lambda *_, **__: pytest.fail("imported"))
        NO_SPAN.stages(Timings(fuse_ms=1.0, encode_ms=1.0, search_ms=1.0, total_ms=3.0))
        NO_SPAN.end("localize", "200", failed=False)


def test_without_the_extra_an_endpoint_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "opentelemetry.exporter.otlp.proto.http.trace_exporter", None)
    with pytest.raises(ExtraMissingError, match=r"pip install \"\.\[otel\]\""):
        Tracing.open("http://127.0.0.1:4318/v1/traces", share=1.0)
