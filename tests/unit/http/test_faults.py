"""A fault inside one request does not affect others."""

import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import grpc
import httpx
import numpy as np
import pytest
import uvicorn
from onnxruntime.capi.onnxruntime_pybind11_state import RuntimeException

from service.confidence.features import FEATURES
from service.grpc.generated.streetfix.v1 import localization_pb2 as pb
from service.grpc.generated.streetfix.v1.localization_pb2_grpc import LocalizationServiceStub
from service.grpc.server import GrpcServer
from service.http.app import create_app
from service.http.protocol import BoundedHttp
from service.imaging import decode
from service.imaging.depth_formats import opencv_decode
from service.localization import localizer
from service.runtime.engine import Engine
from service.runtime.settings import Settings

Parts = Callable[..., dict[str, bytes]]


@pytest.fixture
def engine(bundle_path: Path) -> Iterator[Engine]:
    engine = Engine.open(Settings(maps=(bundle_path,), threads=2, queue=4, request_timeout_s=5.0))
    yield engine
    engine.close()


def post(client: httpx.Client, parts: dict[str, bytes]) -> httpx.Response:
    return client.post("/v1/localize", files={name: (name, data) for name, data in parts.items()})


@pytest.mark.parametrize(
    "error", [RuntimeException("a kernel failed"), cv2.error("bad memory"), MemoryError(), RuntimeError("FAISS: no")]
)
def test_a_native_librarys_exception_ends_its_own_request_alone(
    engine: Engine,
    client_of: Callable[[Engine], httpx.Client],
    parts_of: Parts,
    monkeypatch: pytest.MonkeyPatch,
    error: Exception,
) -> None:
    client, (asked,) = client_of(engine), engine.registry

    def fails(*_: object, **__: object) -> None:
        raise error

    with monkeypatch.context() as patched:
        patched.setattr(asked.encoder, "encode", fails)
        failed = post(client, parts_of())
    assert (failed.status_code, failed.json()["code"]) == (500, "internal")
    assert str(error) not in failed.text or not str(error)
    assert post(client, parts_of()).status_code == 200
    assert (engine.admission.working, engine.admission.waiting) == (0, 0)


def test_an_answer_that_is_not_finite_is_an_internal_error_of_both_faces(
    engine: Engine,
    client_of: Callable[[Engine], httpx.Client],
    parts_of: Parts,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """NaN never reaches a client. The log names the number and the request."""
    parts = parts_of()
    message = pb.LocalizeRequest(
        rgb=parts["rgb"], depth=parts["depth"], camera=pb.Camera(width=64, height=48, fx=32, fy=32, cx=31.5, cy=23.5)
    )
    server = GrpcServer(engine, host="127.0.0.1", port=0)
    server.start()
    monkeypatch.setattr(localizer, "evidence_of", lambda *_: np.full(len(FEATURES), np.nan))
    told = "evidence of the answer is not finite"
    try:
        failed = post(client_of(engine), parts)
        assert (failed.status_code, failed.json()["code"]) == (500, "internal")
        assert failed.json()["request_id"] in caplog.text
        assert told not in failed.text
        assert told in caplog.text
        caplog.clear()
        with grpc.insecure_channel(f"127.0.0.1:{server.port}") as channel, pytest.raises(grpc.RpcError) as caught:
            LocalizationServiceStub(channel).Localize(message, metadata=(("x-request-id", "mine-9"),))
        assert caught.value.code() == grpc.StatusCode.INTERNAL
        assert "mine-9" in str(caught.value.details())
        assert told not in str(caught.value.details())
        assert told in caplog.text
        assert "mine-9" in caplog.text
    finally:
        server.stop(grace_s=0)


def test_a_stuck_request_gets_an_error_and_the_others_are_answered(
    engine: Engine, client_of: Callable[[Engine], httpx.Client], parts_of: Parts, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One of two threads hangs in a decoder. Its caller waits no longer than the time limit of a request."""
    client, hangs, goes_on, real = client_of(engine), threading.Event(), threading.Event(), opencv_decode

    def stuck(data: bytes, flags: int, *, field: str) -> object:
        if not hangs.is_set():
            hangs.set()
            goes_on.wait(60)
        return real(data, flags, field=field)

    monkeypatch.setattr(decode, "opencv_decode", stuck)
    found: list[httpx.Response] = []
    first = threading.Thread(target=lambda: found.append(post(client_of(engine), parts_of())))
    first.start()
    assert hangs.wait(30)
    assert [post(client, parts_of()).status_code for _ in range(3)] == [200, 200, 200]
    first.join(30)
    goes_on.set()
    assert (found[0].status_code, found[0].json()["code"]) == (504, "deadline")


def test_work_without_a_caller_is_dropped(engine: Engine, parts_of: Parts) -> None:
    """The caller closes a real socket while its request waits. The queue slot is free at once."""
    release, hold = threading.Event(), []
    for _ in range(2):
        began = threading.Event()

        def wait(began: threading.Event = began) -> None:
            began.set()
            release.wait(30)

        hold.append(engine.admission.submit(wait))
        assert began.wait(30)
    files = {name: (name, data) for name, data in parts_of().items()}
    asked = httpx.Request("POST", "http://127.0.0.1/v1/localize", files=files)
    head = f"POST /v1/localize HTTP/1.1\r\nHost: localhost\r\nContent-Type: {asked.headers['content-type']}\r\n"
    head += f"Content-Length: {asked.headers['content-length']}\r\n\r\n"
    with socket.create_server(("127.0.0.1", 0)) as listener:
        config = uvicorn.Config(create_app(engine), http=BoundedHttp, lifespan="off", log_config=None)
        server = uvicorn.Server(config)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
        thread.start()
        try:
            with socket.create_connection(listener.getsockname(), timeout=10) as caller:
                caller.sendall(head.encode() + asked.read())
                assert became(lambda: engine.admission.waiting == 1)
            assert became(lambda: engine.admission.waiting == 0)
            assert engine.admission.working == 2
        finally:
            release.set()
            server.should_exit = True
            thread.join()
    for each in hold:
        each.result(30)


def became(true: Callable[[], bool], *, within_s: float = 3.0) -> bool:
    """Wait until a condition holds, for less than the five seconds of a request."""
    until = time.monotonic() + within_s
    while not true() and time.monotonic() < until:
        time.sleep(0.01)
    return true()
