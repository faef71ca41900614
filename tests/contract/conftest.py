"""A service of both faces over real sockets."""

import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import grpc
import httpx
import pytest
import uvicorn

from service.grpc.generated.streetfix.v1.localization_pb2_grpc import LocalizationServiceStub
from service.grpc.server import GrpcServer
from service.http.app import create_app
from service.maps.content import BundleContent
from service.maps.writer import write_bundle
from service.runtime.engine import Engine
from service.runtime.settings import Settings

#: REST, gRPC, and the address of gRPC.
Faces = tuple[httpx.Client, LocalizationServiceStub, str]


@contextmanager
def both_faces(bundle: Path, **settings: Any) -> Iterator[Faces]:
    engine = Engine.open(Settings(maps=(bundle,), threads=1, queue=16, **settings))
    server = uvicorn.Server(uvicorn.Config(create_app(engine), port=0, log_config=None, lifespan="off"))
    thread = threading.Thread(target=server.run)
    thread.start()
    while not server.started:
        assert thread.is_alive()
    port = server.servers[0].sockets[0].getsockname()[1]
    grpc_server = GrpcServer(engine, host="127.0.0.1", port=0)
    grpc_server.start()
    address = f"127.0.0.1:{grpc_server.port}"
    with grpc.insecure_channel(address) as channel, httpx.Client(base_url=f"http://127.0.0.1:{port}") as client:
        yield client, LocalizationServiceStub(channel), address
    grpc_server.stop(grace_s=1)
    server.should_exit = True
    thread.join()
    engine.close()


@pytest.fixture(scope="session")
def serving() -> Callable[..., AbstractContextManager[Faces]]:
    """Return a context manager that serves a map by REST and gRPC on one engine, with given settings."""
    return both_faces


@pytest.fixture(scope="session")
def serving_with_confidence(
    content_of: Callable[..., BundleContent],
    constant_calibration: Callable[..., dict[str, Any]],
    tmp_path_factory: pytest.TempPathFactory,
) -> Callable[..., AbstractContextManager[Faces]]:
    """Return ``serving`` of a map whose calibration gives the same confidence to every answer."""

    def served(**confidence: float) -> AbstractContextManager[Faces]:
        folder: Path = tmp_path_factory.mktemp("confidence") / "tiny"
        write_bundle(folder, content_of(calibration=constant_calibration(**confidence)))
        return both_faces(folder)

    return served
