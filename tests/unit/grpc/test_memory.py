"""The memory budget of messages, over gRPC."""

import gc
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import grpc
import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection_pb2, reflection_pb2_grpc

from service.errors import BusyError
from service.grpc.generated.streetfix.v1 import localization_pb2 as pb
from service.grpc.generated.streetfix.v1.localization_pb2_grpc import LocalizationServiceStub
from service.grpc.memory import MessageMemory
from service.grpc.reading import SERVICE
from service.runtime.admission import MIB, MemoryBudget
from service.runtime.engine import Engine
from service.runtime.settings import Limits, Settings

Parts = Callable[..., dict[str, bytes]]
CAMERA = pb.Camera(width=64, height=48, fx=32, fy=32, cx=31.5, cy=23.5)


@pytest.fixture
def engine(bundle_path: Path, request: pytest.FixtureRequest) -> Iterator[Engine]:
    timeout_s = getattr(request, "param", 5)
    engine = Engine.open(
        Settings(maps=(bundle_path,), threads=1, request_timeout_s=timeout_s, limits=Limits(max_request_bytes=MIB))
    )
    engine.memory = MemoryBudget(8 * MIB, messages=2)
    yield engine
    engine.close()


@pytest.fixture
def message(parts_of: Parts) -> pb.LocalizeRequest:
    parts = parts_of()
    return pb.LocalizeRequest(rgb=parts["rgb"], depth=parts["depth"], camera=CAMERA)


def becomes(true: Callable[[], bool]) -> bool:
    until = time.monotonic() + 30
    while not true():
        if time.monotonic() > until:
            return False
        time.sleep(0.01)
    return True


@pytest.mark.parametrize("good", [True, False])
@pytest.mark.parametrize("method", ["Localize", "LocalizeBatch", "LocalizeSequence", "LocalizeStream"])
def test_all_is_given_back_after_an_answer_and_after_an_error(
    engine: Engine, stub: LocalizationServiceStub, message: pb.LocalizeRequest, method: str, good: bool
) -> None:
    if not good:
        message.depth_format.scale_m, message.depth_format.max_range_m = 0.001, 0.01
    requests: dict[str, Any] = {
        "Localize": message,
        "LocalizeBatch": pb.LocalizeBatchRequest(requests=[message, message]),
        "LocalizeSequence": pb.LocalizeSequenceRequest(
            frames=[
                pb.SequenceFrame(rgb=message.rgb, depth=message.depth, camera=CAMERA, depth_format=message.depth_format)
            ]
        ),
    }
    gc.collect()
    gc.disable()  # what lives on now is held by somebody, not only by itself
    try:
        if method == "LocalizeStream":
            (outcome,) = stub.LocalizeStream(iter([pb.LocalizeStreamRequest(frame=message)]))
            assert outcome.outcome.HasField("answer") == good
        elif method == "LocalizeBatch":
            assert stub.LocalizeBatch(requests[method]).outcomes[1].HasField("answer") == good
        elif good:
            getattr(stub, method)(requests[method])
        else:
            with pytest.raises(grpc.RpcError) as caught:
                getattr(stub, method)(requests[method])
            assert caught.value.code() == grpc.StatusCode.INVALID_ARGUMENT
        assert becomes(lambda: engine.memory.held == 0)
    finally:
        gc.enable()


def test_a_message_that_does_not_fit_is_refused_with_when_to_come_back(
    engine: Engine, stub: LocalizationServiceStub, message: pb.LocalizeRequest
) -> None:
    with engine.memory.hold() as others:
        others.grow(8 * MIB - len(message.SerializeToString()) + 1)
        with pytest.raises(grpc.RpcError) as caught:
            stub.Localize(message)
        error: Any = caught.value  # a call, too
        assert error.code() == grpc.StatusCode.RESOURCE_EXHAUSTED
        assert "google.rpc.RetryInfo" in str(dict(error.trailing_metadata())["grpc-status-details-bin"])
    assert stub.Localize(message).HasField("pose")
    assert 'streetfix_requests_total{code="busy",face="grpc",method="Localize"} 1.0' in engine.metrics.text().decode()


# The silent calls must live longer than the 5 s after which a call that waits for its turn is refused.
@pytest.mark.parametrize("engine", [120], indirect=True)
def test_no_more_messages_are_read_at_once_than_there_is_memory_for(
    engine: Engine, channel: grpc.Channel, stub: LocalizationServiceStub, message: pb.LocalizeRequest
) -> None:
    """Calls that never send their message keep their turn until they end."""
    over = threading.Event()

    def silent() -> Iterator[bytes]:
        over.wait(120)
        yield from ()

    call = channel.stream_unary(f"/{SERVICE}/Localize", bytes, bytes)
    slow = [call.future(silent()) for _ in range(2)]

    def is_refused() -> bool:
        try:
            stub.Localize(message)
        except grpc.RpcError as error:
            return error.code() == grpc.StatusCode.RESOURCE_EXHAUSTED
        return False

    assert becomes(is_refused)
    health = health_pb2_grpc.HealthStub(channel).Check(health_pb2.HealthCheckRequest())
    assert health.status == health_pb2.HealthCheckResponse.SERVING
    reflected = reflection_pb2_grpc.ServerReflectionStub(channel).ServerReflectionInfo(
        iter([reflection_pb2.ServerReflectionRequest(list_services="")])
    )
    assert next(reflected).HasField("list_services_response")
    over.set()
    for each in slow:
        each.cancel()
    assert becomes(lambda: not is_refused())


def test_health_is_answered_while_others_hold_its_turn_and_send_nothing(channel: grpc.Channel) -> None:
    """Health checks need no key, so no caller may block them."""
    over = threading.Event()

    def silent() -> Iterator[bytes]:
        over.wait(30)
        yield from ()

    held = [channel.stream_unary("/grpc.health.v1.Health/Check", bytes, bytes).future(silent()) for _ in range(4)]
    for _ in range(5):
        answer = health_pb2_grpc.HealthStub(channel).Check(health_pb2.HealthCheckRequest(), timeout=10)
        assert answer.status == health_pb2.HealthCheckResponse.SERVING
    over.set()
    for each in held:
        each.cancel()


def test_reflection_reads_one_message_at_a_time(channel: grpc.Channel) -> None:
    """Reflection messages have no reservation. So the service must not read a hundred large ones at once."""
    over = threading.Event()

    def silent() -> Iterator[bytes]:
        over.wait(30)
        yield from ()

    path = "/grpc.reflection.v1alpha.ServerReflection/ServerReflectionInfo"
    calls: list[Any] = [channel.stream_stream(path, bytes, bytes)(silent()) for _ in range(4)]
    ended = []
    for call in calls:
        with pytest.raises((grpc.RpcError, StopIteration)):
            next(call)
        ended.append(call.code())
    over.set()
    assert ended.count(grpc.StatusCode.RESOURCE_EXHAUSTED) >= 2


def test_open_streams_are_weighed_by_the_largest_message(
    engine: Engine, stub: LocalizationServiceStub, message: pb.LocalizeRequest
) -> None:
    over, streams = threading.Event(), []

    def one_frame() -> Iterator[pb.LocalizeStreamRequest]:
        yield pb.LocalizeStreamRequest(frame=message)
        over.wait(30)

    for _ in range(4):  # half of eight
        streams.append(stub.LocalizeStream(one_frame()))
        assert next(streams[-1]).outcome.HasField("answer")
    assert engine.memory.held >= 4 * MIB
    with pytest.raises(grpc.RpcError) as caught:
        next(stub.LocalizeStream(one_frame()))
    assert caught.value.code() == grpc.StatusCode.RESOURCE_EXHAUSTED
    over.set()
    for stream in streams:
        assert list(stream) == []
    assert becomes(lambda: engine.memory.held == 0)


def test_a_stream_needs_room_in_the_budget() -> None:
    budget = MemoryBudget(8 * MIB, messages=1)
    memory = MessageMemory(budget, most_bytes=MIB, most_streams=2)
    assert memory.streams == 2
    with budget.hold() as others:
        others.grow(8 * MIB)
        with pytest.raises(BusyError), memory.stream():
            pass
    with memory.stream():
        assert budget.held == MIB
    assert budget.held == 0
