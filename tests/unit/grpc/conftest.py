"""A gRPC server of the engine under test, on loopback."""

from collections.abc import Iterator

import grpc
import pytest

from service.grpc.generated.streetfix.v1.localization_pb2_grpc import LocalizationServiceStub
from service.grpc.server import GrpcServer
from service.runtime.engine import Engine


@pytest.fixture
def channel(engine: Engine) -> Iterator[grpc.Channel]:
    server = GrpcServer(engine, host="127.0.0.1", port=0)
    server.start()
    with grpc.insecure_channel(f"127.0.0.1:{server.port}") as channel:
        yield channel
    server.stop(grace_s=0)


@pytest.fixture
def stub(channel: grpc.Channel) -> LocalizationServiceStub:
    return LocalizationServiceStub(channel)
