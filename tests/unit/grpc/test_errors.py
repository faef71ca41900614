"""The errors that a gRPC client receives."""

import io
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import pytest
from google.rpc import error_details_pb2
from grpc_health.v1 import health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection_pb2, reflection_pb2_grpc
from grpc_status import rpc_status

from service.errors import AddressError, Kind
from service.grpc.generated.streetfix.v1 import localization_pb2 as pb
from service.grpc.generated.streetfix.v1.localization_pb2_grpc import LocalizationServiceStub
from service.grpc.reading import SERVICE
from service.grpc.server import GrpcServer
from service.grpc.status import CODE_OF_KIND
from service.runtime.engine import Engine
from service.runtime.keys import KeyRing
from service.runtime.settings import Limits, Settings

Parts = Callable[..., dict[str, bytes]]
CAMERA = pb.Camera(width=64, height=48, fx=32, fy=32, cx=31.5, cy=23.5)
#: Numbers of no member of the enumerations, as protobuf takes them.
UNKNOWN_MODEL: dict[str, Any] = {"model": 7, "width": 64, "height": 48, "fx": 32, "fy": 32}
UNKNOWN_KIND: dict[str, Any] = {"kind": 9}


def settings_of(bundle_path: Path) -> Settings:
    limits = Limits(max_request_bytes=200_000)
    return Settings(maps=(bundle_path,), threads=1, queue=1, grpc_streams=1, request_timeout_s=2, limits=limits)


@pytest.fixture
def engine(bundle_path: Path) -> Iterator[Engine]:
    engine = Engine.open(settings_of(bundle_path))
    yield engine
    engine.close()


@pytest.fixture(scope="module")
def refusing(bundle_path: Path) -> Iterator[grpc.Channel]:
    """A server of the tests whose requests reach no map. One is enough: to open a map takes longer than to refuse a request."""
    engine = Engine.open(settings_of(bundle_path))
    server = GrpcServer(engine, host="127.0.0.1", port=0)
    server.start()
    with grpc.insecure_channel(f"127.0.0.1:{server.port}") as channel:
        yield channel
    server.stop(grace_s=0)
    engine.close()


@pytest.fixture
def request_of(parts_of: Parts) -> Callable[..., pb.LocalizeRequest]:
    def make(**changed: Any) -> pb.LocalizeRequest:
        parts = parts_of()
        given: dict[str, Any] = {"rgb": parts["rgb"], "depth": parts["depth"], "camera": CAMERA} | changed
        return pb.LocalizeRequest(**{name: value for name, value in given.items() if value is not None})

    return make


def details(error: Any) -> dict[str, Any]:
    """Return the details of a refused call by type."""
    kinds = {
        "ErrorInfo": error_details_pb2.ErrorInfo,
        "BadRequest": error_details_pb2.BadRequest,
        "RetryInfo": error_details_pb2.RetryInfo,
    }
    found = {}
    status = rpc_status.from_call(error)
    for detail in () if status is None else status.details:
        name = detail.type_url.rsplit(".", 1)[-1]
        found[name] = kinds[name]()
        detail.Unpack(found[name])
    return found


@pytest.mark.parametrize(
    ("changed", "code", "reason", "field"),
    [
        ({"camera": None}, grpc.StatusCode.INVALID_ARGUMENT, "request", "camera"),
        (
            {"camera": pb.Camera(width=64, height=48, fx=0, fy=32)},
            grpc.StatusCode.INVALID_ARGUMENT,
            "request",
            "camera.fx",
        ),
        ({"camera": UNKNOWN_MODEL}, grpc.StatusCode.INVALID_ARGUMENT, "request", "camera.model"),
        ({"depth_format": UNKNOWN_KIND}, grpc.StatusCode.INVALID_ARGUMENT, "request", "depth.kind"),
        (
            {"depth_format": pb.DepthFormat(scale_m=float("nan"))},
            grpc.StatusCode.INVALID_ARGUMENT,
            "request",
            "depth.scale_m",
        ),
        ({"options": pb.Options(neighbours=51)}, grpc.StatusCode.INVALID_ARGUMENT, "request", "options.neighbours"),
        (
            {"vehicle_from_camera": pb.RigidTransform()},
            grpc.StatusCode.INVALID_ARGUMENT,
            "request",
            "T_vehicle_camera.orientation",
        ),
        ({"rgb": b"GIF89a" + bytes(50)}, grpc.StatusCode.INVALID_ARGUMENT, "format", "rgb"),
        ({"depth": b""}, grpc.StatusCode.INVALID_ARGUMENT, "undecodable", "depth"),
        ({"map": "../west"}, grpc.StatusCode.NOT_FOUND, "unknown-map", None),
        (
            {"prior": pb.Prior(wgs84=pb.PriorWgs84(latitude_deg=1))},
            grpc.StatusCode.INVALID_ARGUMENT,
            "request",
            "prior.wgs84",
        ),
    ],
)
def test_an_invalid_request_has_error_details(
    refusing: grpc.Channel, request_of: Any, changed: dict[str, Any], code: Any, reason: str, field: str | None
) -> None:
    with pytest.raises(grpc.RpcError) as caught:
        LocalizationServiceStub(refusing).Localize(request_of(**changed))
    assert caught.value.code() == code
    found = details(caught.value)
    assert (found["ErrorInfo"].reason, found["ErrorInfo"].domain) == (reason, "streetfix")
    if field is None:
        assert "BadRequest" not in found
    else:
        (violation,) = found["BadRequest"].field_violations
        assert violation.field == field
        assert violation.description == caught.value.details()
    assert "RetryInfo" not in found


def test_a_depth_in_millimetres_is_reported_with_its_scale(
    stub: LocalizationServiceStub, request_of: Any, pictures: Any
) -> None:
    np.save(file := io.BytesIO(), pictures[1] * np.float32(1000))
    with pytest.raises(grpc.RpcError) as caught:
        stub.Localize(request_of(depth=file.getvalue()), timeout=10)
    assert caught.value.code() is grpc.StatusCode.INVALID_ARGUMENT
    assert "which looks like millimetres; send depth.scale_m = 0.001" in str(caught.value.details())


def test_a_message_beyond_the_limit_is_refused(refusing: grpc.Channel, request_of: Any) -> None:
    with pytest.raises(grpc.RpcError) as caught:
        LocalizationServiceStub(refusing).Localize(request_of(rgb=bytes(300_000)))
    assert caught.value.code() == grpc.StatusCode.RESOURCE_EXHAUSTED


@pytest.mark.parametrize(
    ("limits", "accepted"),
    [
        (Limits(max_message_bytes=1024), False),
        (Limits(max_message_bytes=2**20, max_request_bytes=1024), False),
        (Limits(max_message_bytes=2**20), True),
    ],
)
def test_a_message_may_be_as_long_as_both_limits_say(
    bundle_path: Path, request_of: Any, limits: Limits, accepted: bool
) -> None:
    """The same valid request of about 10 KiB."""
    assert 1024 < request_of().ByteSize() < 2**20
    engine = Engine.open(Settings(maps=(bundle_path,), threads=1, limits=limits))
    server = GrpcServer(engine, host="127.0.0.1", port=0)
    server.start()
    try:
        with grpc.insecure_channel(f"127.0.0.1:{server.port}") as channel:
            if accepted:
                assert LocalizationServiceStub(channel).Localize(request_of()).map.name == "tiny"
            else:
                with pytest.raises(grpc.RpcError) as caught:
                    LocalizationServiceStub(channel).Localize(request_of())
                assert caught.value.code() == grpc.StatusCode.RESOURCE_EXHAUSTED
    finally:
        server.stop(grace_s=0)
        engine.close()


@pytest.mark.parametrize("count", [0, 17])
def test_a_batch_of_none_or_of_too_many_is_refused(refusing: grpc.Channel, count: int) -> None:
    with pytest.raises(grpc.RpcError) as caught:
        LocalizationServiceStub(refusing).LocalizeBatch(
            pb.LocalizeBatchRequest(requests=[pb.LocalizeRequest()] * count)
        )
    assert details(caught.value)["BadRequest"].field_violations[0].field == "requests"


@pytest.fixture
def held(engine: Engine) -> Iterator[threading.Event]:
    """Keep the only worker busy until the event is set."""
    release, began = threading.Event(), threading.Event()

    def hold() -> None:
        began.set()
        release.wait(30)

    engine.admission.submit(hold)
    assert began.wait(10)
    yield release
    release.set()


def test_beyond_the_queue_a_call_is_refused_at_once_with_a_retry_time(
    stub: LocalizationServiceStub, request_of: Any, engine: Engine, held: threading.Event
) -> None:
    waiting = engine.admission.submit(lambda: None)
    with pytest.raises(grpc.RpcError) as caught:
        stub.Localize(request_of())
    assert caught.value.code() == grpc.StatusCode.RESOURCE_EXHAUSTED
    found = details(caught.value)
    assert found["ErrorInfo"].reason == "busy"
    assert found["RetryInfo"].retry_delay.seconds == 1
    outcome = stub.LocalizeBatch(pb.LocalizeBatchRequest(requests=[request_of()])).outcomes[0]
    assert (outcome.problem.code, outcome.problem.field) == ("busy", "requests.0")
    held.set()
    waiting.result(10)
    assert stub.Localize(request_of()).map.name == "tiny"


def test_work_whose_deadline_has_passed_is_dropped(
    stub: LocalizationServiceStub, request_of: Any, engine: Engine, held: threading.Event
) -> None:
    with pytest.raises(grpc.RpcError) as caught:
        stub.Localize(request_of(), timeout=0.2)
    assert caught.value.code() == grpc.StatusCode.DEADLINE_EXCEEDED
    # The place in the queue (there is one) comes back although the worker is still busy.
    for _ in range(100):
        try:
            later = engine.admission.submit(lambda: "ran")
            break
        except Exception:
            threading.Event().wait(0.05)
    held.set()
    assert later.result(10) == "ran"


def test_work_without_a_caller_is_dropped(
    stub: LocalizationServiceStub,
    request_of: Any,
    engine: Engine,
    held: threading.Event,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """The queue slot is free again while the worker is still busy."""
    call = stub.Localize.future(request_of())
    assert became(lambda: engine.admission.waiting == 1, within_s=10)
    call.cancel()
    assert became(lambda: engine.admission.waiting == 0, within_s=1)  # sooner than its time is over
    assert engine.admission.working == 1
    held.set()
    assert stub.Localize(request_of()).map.name == "tiny"
    cancelled = 'streetfix_requests_total{code="CANCELLED"'
    assert became(lambda: cancelled in engine.metrics.text().decode(), within_s=10)
    assert not [record for record in caplog.records if record.exc_info]  # who leaves is no defect of ours


def became(true: Callable[[], bool], *, within_s: float) -> bool:
    until = time.monotonic() + within_s
    while not true() and time.monotonic() < until:
        time.sleep(0.01)
    return true()


def test_the_services_own_limit_of_time_holds_where_the_caller_has_none(
    stub: LocalizationServiceStub, request_of: Any, held: threading.Event
) -> None:
    with pytest.raises(grpc.RpcError) as caught:
        stub.Localize(request_of())
    assert caught.value.code() == grpc.StatusCode.DEADLINE_EXCEEDED
    assert details(caught.value)["ErrorInfo"].reason == "deadline"


def test_streams_are_limited_and_given_back(stub: LocalizationServiceStub, request_of: Any) -> None:
    go_on = threading.Event()

    def drive() -> Iterator[pb.LocalizeStreamRequest]:
        yield pb.LocalizeStreamRequest(frame=request_of())
        go_on.wait(10)

    first = stub.LocalizeStream(drive())
    assert next(first).frames == 1
    with pytest.raises(grpc.RpcError) as caught:
        next(stub.LocalizeStream(iter([pb.LocalizeStreamRequest(frame=request_of())])))
    assert details(caught.value)["ErrorInfo"].reason == "busy"
    go_on.set()
    assert list(first) == []
    assert next(stub.LocalizeStream(iter([pb.LocalizeStreamRequest(frame=request_of())]))).frames == 1


def test_a_stream_stays_with_its_map(stub: LocalizationServiceStub, request_of: Any) -> None:
    frames = [pb.LocalizeStreamRequest(frame=request_of(map=name)) for name in ("tiny", "west", "tiny")]
    first, second, third = stub.LocalizeStream(iter(frames))
    assert second.outcome.problem.field == "frame 1.map"
    assert (first.frames, third.frames) == (1, 1)


def test_an_unexpected_error_contains_the_request_id_only(
    stub: LocalizationServiceStub, request_of: Any, engine: Engine, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(_: object) -> None:
        raise RuntimeError("a secret")

    monkeypatch.setattr(engine, "localize", fails)
    with pytest.raises(grpc.RpcError) as caught:
        stub.Localize(request_of(), metadata=(("x-request-id", "mine-1"),))
    error: Any = caught.value  # a call, too
    assert error.code() == grpc.StatusCode.INTERNAL
    assert "mine-1" in error.details()
    assert "secret" not in error.details()
    assert dict(error.initial_metadata())["x-request-id"] == "mine-1"


def test_health_follows_readiness(channel: grpc.Channel, engine: Engine) -> None:
    health = health_pb2_grpc.HealthStub(channel)
    kinds = health_pb2.HealthCheckResponse
    for expected in (kinds.SERVING, kinds.NOT_SERVING):
        for name in ("", SERVICE):
            assert health.Check(health_pb2.HealthCheckRequest(service=name)).status == expected
        engine.drain()
    with pytest.raises(grpc.RpcError) as caught:
        health.Check(health_pb2.HealthCheckRequest(service="x" * 10_000))
    assert caught.value.code() == grpc.StatusCode.NOT_FOUND


def test_health_is_not_watched(refusing: grpc.Channel) -> None:
    """A watcher would hold a thread without a key. It would also hold the lock of the standard servicer while it does not read."""
    with pytest.raises(grpc.RpcError) as caught:
        next(health_pb2_grpc.HealthStub(refusing).Watch(health_pb2.HealthCheckRequest()))
    assert caught.value.code() == grpc.StatusCode.UNIMPLEMENTED


def test_reflection(refusing: grpc.Channel) -> None:
    asked = [reflection_pb2.ServerReflectionRequest(list_services="")]
    (answer,) = reflection_pb2_grpc.ServerReflectionStub(refusing).ServerReflectionInfo(iter(asked))
    assert SERVICE in [service.name for service in answer.list_services_response.service]
    assert SERVICE == "streetfix.v1.LocalizationService"


def test_a_port_that_is_taken_is_named(engine: Engine) -> None:
    server = GrpcServer(engine, host="127.0.0.1", port=0)
    server.start()
    try:
        with pytest.raises(AddressError, match=f"127.0.0.1:{server.port}.*--grpc-port"):
            GrpcServer(engine, host="127.0.0.1", port=server.port)
    finally:
        server.stop(grace_s=0)


def raw_call(channel: grpc.Channel, name: str) -> Any:
    """Make a call with raw bytes as messages."""
    return channel.stream_unary(f"/{SERVICE}/{name}", bytes, bytes)


def test_a_message_that_is_many_little_ones_is_refused_unparsed(refusing: grpc.Channel) -> None:
    """50,000 empty requests of two bytes each would take a hundred times their size in memory."""
    with pytest.raises(grpc.RpcError) as caught:
        raw_call(refusing, "LocalizeBatch")(iter([b"\x0a\x00" * 50_000]))
    assert caught.value.code() == grpc.StatusCode.INVALID_ARGUMENT
    assert "more than 64 top-level fields" in str(caught.value.details())


@pytest.mark.parametrize("raw", [b"\xff", b"\x0a\x05ab", b"\x0b", b"\x08" + b"\x80" * 11, b"\x09\x00"])
def test_bytes_that_are_no_message_are_refused(refusing: grpc.Channel, raw: bytes) -> None:
    with pytest.raises(grpc.RpcError) as caught:
        raw_call(refusing, "Localize")(iter([raw]))
    assert caught.value.code() == grpc.StatusCode.INVALID_ARGUMENT


def test_a_call_that_never_sends_its_message_is_ended(channel: grpc.Channel, stub: LocalizationServiceStub) -> None:
    """More such calls than threads end, and then other calls are answered. The service waits two seconds."""
    silence = threading.Event()

    def silent() -> Iterator[bytes]:
        silence.wait(30)
        yield b""

    calls = [raw_call(channel, "Localize").future(silent()) for _ in range(40)]
    assert all(call.exception(timeout=20) is not None for call in calls)

    def answered() -> bool:
        """Wait for an answer: the client sees the end shortly before the server frees the slot of the call."""
        try:
            return stub.ListMaps(pb.ListMapsRequest(), timeout=10).maps[0].name == "tiny"
        except grpc.RpcError as error:
            if error.code() != grpc.StatusCode.RESOURCE_EXHAUSTED:
                raise
            return False

    assert became(answered, within_s=10)
    silence.set()


def test_a_stream_keeps_nothing_of_its_frames(
    stub: LocalizationServiceStub, request_of: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    from service.grpc import answering
    from service.grpc.call import Call

    calls: list[Call] = []

    class Watched(Call):
        def __init__(self, *arguments: Any, **named: Any) -> None:
            super().__init__(*arguments, **named)
            calls.append(self)

    monkeypatch.setattr(answering, "Call", Watched)
    frames = [pb.LocalizeStreamRequest(frame=request_of(**({"rgb": b"nothing"} if k % 2 else {}))) for k in range(6)]
    answers = list(stub.LocalizeStream(iter(frames)))
    assert [each.outcome.WhichOneof("outcome") for each in answers] == ["answer", "problem"] * 3
    assert [len(call._under_way) for call in calls] == [0]


def test_a_silent_stream_is_ended(bundle_path: Path, request_of: Any) -> None:
    engine = Engine.open(Settings(maps=(bundle_path,), threads=1, grpc_idle_s=0.5))
    server = GrpcServer(engine, host="127.0.0.1", port=0)
    server.start()
    silence = threading.Event()

    def drive() -> Iterator[pb.LocalizeStreamRequest]:
        yield pb.LocalizeStreamRequest(frame=request_of())
        silence.wait(20)

    with grpc.insecure_channel(f"127.0.0.1:{server.port}") as channel:
        answers = LocalizationServiceStub(channel).LocalizeStream(drive())
        assert next(answers).frames == 1
        with pytest.raises(grpc.RpcError) as caught:
            next(answers)
        assert caught.value.code() == grpc.StatusCode.CANCELLED
    silence.set()
    server.stop(grace_s=0)
    engine.close()


def test_without_a_key_nothing_is_parsed_and_nothing_waited_for(bundle_path: Path) -> None:
    engine = Engine.open(Settings(maps=(bundle_path,), threads=1, queue=1, grpc_streams=0))
    server = GrpcServer(engine, host="127.0.0.1", port=0, keys=KeyRing({}))
    server.start()
    silence = threading.Event()

    def silent() -> Iterator[bytes]:
        silence.wait(30)
        yield b""

    with grpc.insecure_channel(f"127.0.0.1:{server.port}") as channel:
        calls = [raw_call(channel, name).future(silent()) for name in ("Localize", "LocalizeBatch") for _ in range(30)]
        assert {call.exception(timeout=20).code() for call in calls} == {grpc.StatusCode.UNAUTHENTICATED}
        streams = [LocalizationServiceStub(channel).LocalizeStream(iter([])) for _ in range(3)]
        for stream in streams:
            with pytest.raises(grpc.RpcError) as caught:
                next(stream)
            assert caught.value.code() == grpc.StatusCode.UNAUTHENTICATED
    silence.set()
    assert 'code="unauthorized",face="grpc",method="Localize"} 30.0' in engine.metrics.text().decode()
    server.stop(grace_s=0)
    engine.close()


def test_a_stream_goes_on_when_another_map_comes_beside_its_own(
    bundle_path: Path, parts_of: Parts, content_of: Any, tmp_path: Path
) -> None:
    from service.contract.convert import parsed, query_from
    from service.contract.schema import LocalizeRequest
    from service.geometry.rigid import transform_from
    from service.localization.localizer import Localizer
    from service.maps.reader import MapBundle
    from service.maps.writer import write_bundle
    from service.runtime.stream import Stream

    engine = Engine.open(Settings(maps=(bundle_path,), threads=1))
    parts = parts_of()
    query = query_from(parsed(parts["request"], LocalizeRequest), rgb=parts["rgb"], depth=parts["depth"])
    stream, ahead = Stream(engine), transform_from(np.eye(3), np.array([0.0, 0.0, 1.0]))
    assert stream.localize(query, None)[1] == 1
    write_bundle(tmp_path / "west", content_of(name="west"))
    engine.registry.mount(Localizer.open(MapBundle.open(tmp_path / "west")))
    assert stream.localize(query, ahead)[1] == 2
    write_bundle(tmp_path / "new", content_of(seed=1))
    engine.registry.mount(Localizer.open(MapBundle.open(tmp_path / "new")))
    assert stream.localize(query, ahead)[1] == 1  # what was looked up is not of the new version
    engine.close()


def test_every_kind_of_error_has_a_code() -> None:
    from typing import get_args

    assert set(CODE_OF_KIND) == set(get_args(Kind))
