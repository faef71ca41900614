"""Bytes that are no valid message end a call like any invalid request, for every call and every part of the message."""

import logging
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import grpc
import pytest
from google.rpc import error_details_pb2
from grpc_reflection.v1alpha import reflection_pb2
from grpc_status import rpc_status

from service.errors import RequestError
from service.grpc.generated.streetfix.v1 import localization_pb2 as pb
from service.grpc.parsing import _varint_of, parsed
from service.grpc.reading import SERVICE
from service.grpc.server import GrpcServer
from service.runtime.engine import Engine
from service.runtime.settings import Settings

# The stubs know two kinds of descriptors, of which one is at work.
REQUEST: Any = pb.LocalizeRequest.DESCRIPTOR
BATCH: Any = pb.LocalizeBatchRequest.DESCRIPTOR
SEQUENCE, STREAM = pb.LocalizeSequenceRequest.DESCRIPTOR, pb.LocalizeStreamRequest.DESCRIPTOR
CAMERA = pb.Camera(width=64, height=48, fx=32, fy=32, cx=31.5, cy=23.5)
SECRET = b"s3cret"


def field(number: int, content: bytes) -> bytes:
    """Encode a length-delimited field. The number is below 16, the content below 128 bytes."""
    assert number < 16
    assert len(content) < 128
    return bytes([number << 3 | 2, len(content)]) + content


#: A double that is cut off; a message of no field.
CUT, NONE = b"\x21" + SECRET, b"\xff\xff\xff"
NOT_UTF8 = b"\xff" + SECRET


@pytest.mark.parametrize(
    ("message", "raw", "at_fault"),
    [
        (REQUEST, field(1, NOT_UTF8), "map"),
        (REQUEST, field(4, CUT), "camera"),
        (REQUEST, field(4, field(8, b"1234567")), "camera.distortion"),
        (REQUEST, field(2, NOT_UTF8) + field(9, field(1, CUT)), "prior.position"),  # rgb is bytes, not text
        (REQUEST, field(7, field(2, NONE)), "vehicle_from_camera.orientation"),
        (REQUEST, b"\x00\x01", ""),  # there is no field 0
        (REQUEST, CUT, ""),
        (BATCH, field(1, b"") + field(1, field(1, NOT_UTF8)), "requests.1.map"),
        (SEQUENCE, field(2, b"") * 3 + field(2, field(6, NONE)), "frames.3.reference_from_camera"),
        (STREAM, field(1, field(4, CUT)), "frame.camera"),
        (STREAM, field(2, CUT), "previous_from_camera"),
    ],
)
def test_the_innermost_field_that_does_not_parse_is_named(message: Any, raw: bytes, at_fault: str) -> None:
    with pytest.raises(RequestError) as caught:
        parsed(raw, message)
    assert caught.value.field == at_fault
    unnamed = ("the bytes do not match the proto", "the bytes are not a protobuf message")
    assert caught.value.message.startswith(f"{at_fault}: the bytes" if at_fault else unnamed)
    assert "s3cret" not in caught.value.message


def test_valid_bytes_are_parsed() -> None:
    message = pb.LocalizeRequest(map="tiny", rgb=b"\xff" * 200, camera=CAMERA, options=pb.Options(refine=False))
    assert parsed(message.SerializeToString(), REQUEST) == message
    unknown = field(15, NONE)  # of a later contract
    assert parsed(unknown, REQUEST) == pb.LocalizeRequest.FromString(unknown)


def test_the_search_for_the_field_ends_in_a_message_of_very_many() -> None:
    """Each field has two bytes. Without a limit, the search in a message of 40 MiB takes half a minute."""
    inner = field(4, b"") * 1_000_000 + field(4, CUT)
    raw = b"\x0a" + _varint_of(len(inner)) + inner
    with pytest.raises(RequestError) as caught:
        parsed(raw, BATCH)
    assert caught.value.field == "requests.0"


@pytest.fixture(scope="module")
def served(bundle_path: Path) -> Iterator[tuple[Engine, grpc.Channel]]:
    engine = Engine.open(Settings(maps=(bundle_path,), threads=1))
    server = GrpcServer(engine, host="127.0.0.1", port=0)
    server.start()
    with grpc.insecure_channel(f"127.0.0.1:{server.port}") as channel:
        yield engine, channel
    server.stop(grace_s=0)
    engine.close()


def counted(engine: Engine, method: str, *, code: str = "request") -> float:
    """Return how many calls of a method ended with a code, by the metrics."""
    name = f'streetfix_requests_total{{code="{code}",face="grpc",method="{method}"}} '
    lines = engine.metrics.text().decode().splitlines()
    return sum(float(line.removeprefix(name)) for line in lines if line.startswith(name))


#: Every call that the server knows, with bytes that pass as a message at their top and do not parse, and the field at fault.
CALLS = [
    (f"/{SERVICE}/Localize", field(4, CUT), "camera"),
    (f"/{SERVICE}/LocalizeBatch", field(1, field(1, NOT_UTF8)), "requests.0.map"),
    (f"/{SERVICE}/LocalizeSequence", field(2, field(3, CUT)), "frames.0.camera"),
    (f"/{SERVICE}/LocalizeStream", field(1, field(4, CUT)), "frame 0.camera"),
    (f"/{SERVICE}/ListMaps", NONE, ""),  # it has no fields
    (f"/{SERVICE}/GetStreets", field(1, NOT_UTF8), "map"),
    (f"/{SERVICE}/GetCoverage", field(1, NOT_UTF8), "map"),
    ("/grpc.health.v1.Health/Check", field(1, NOT_UTF8), "service"),
    ("/grpc.health.v1.Health/Watch", field(1, NOT_UTF8), "service"),
    ("/grpc.reflection.v1alpha.ServerReflection/ServerReflectionInfo", field(1, NOT_UTF8), "host"),
]


def test_every_call_of_ours_is_among_them() -> None:
    ours = pb.DESCRIPTOR.services_by_name["LocalizationService"].methods_by_name
    assert {f"/{SERVICE}/{name}" for name in ours} <= {path for path, _, _ in CALLS}


@pytest.mark.parametrize(("path", "raw", "at_fault"), CALLS)
@pytest.mark.parametrize("at_its_top", [False, True])
def test_every_call_refuses_them_with_the_field_and_a_request_id_and_counts_it(
    served: Any, caplog: pytest.LogCaptureFixture, path: str, raw: bytes, at_fault: str, at_its_top: bool
) -> None:
    engine, channel = served
    raw, at_fault = (NONE, "frame 0" if at_fault.startswith("frame 0") else "") if at_its_top else (raw, at_fault)
    method = path.rsplit("/", 1)[1]
    before = counted(engine, method)
    with caplog.at_level(logging.INFO), pytest.raises(grpc.RpcError) as caught:
        list(channel.stream_stream(path)(iter([raw]), timeout=20, metadata=(("x-request-id", "mine-7"),)))
    error: Any = caught.value  # a call, too
    assert error.code() == grpc.StatusCode.INVALID_ARGUMENT
    status = rpc_status.from_call(error)
    assert status is not None
    info, bad = error_details_pb2.ErrorInfo(), error_details_pb2.BadRequest()
    assert status.details[0].Unpack(info)
    assert status.details[1].Unpack(bad)
    assert (info.reason, [each.field for each in bad.field_violations]) == ("request", [at_fault])
    assert dict(error.initial_metadata())["x-request-id"] == "mine-7"
    assert counted(engine, method) == before + 1
    told = caplog.text + error.details()
    assert "Traceback" not in told
    assert "s3cret" not in told
    assert [record.figures["request_id"] for record in caplog.records if hasattr(record, "figures")] == ["mine-7"]


def test_a_good_frame_before_a_bad_one_is_answered(served: Any, parts_of: Any) -> None:
    _, channel = served
    parts = parts_of()
    good = pb.LocalizeStreamRequest(frame=pb.LocalizeRequest(rgb=parts["rgb"], depth=parts["depth"], camera=CAMERA))
    answers = channel.stream_stream(
        f"/{SERVICE}/LocalizeStream", response_deserializer=pb.LocalizeStreamResponse.FromString
    )(iter([good.SerializeToString(), field(2, CUT)]), timeout=20)
    assert next(answers).frames == 1
    with pytest.raises(grpc.RpcError) as caught:
        next(answers)
    assert caught.value.code() == grpc.StatusCode.INVALID_ARGUMENT
    assert str(caught.value.details()).startswith("frame 1: previous_from_camera: ")


def test_reflection_and_health_answer_as_before(served: Any) -> None:
    _, channel = served
    asked = reflection_pb2.ServerReflectionRequest(file_containing_symbol=SERVICE).SerializeToString()
    reflected = channel.stream_stream("/grpc.reflection.v1alpha.ServerReflection/ServerReflectionInfo")
    assert b"localization.proto" in next(reflected(iter([asked]), timeout=20))
    assert channel.unary_unary("/grpc.health.v1.Health/Check")(b"", timeout=20) == b"\x08\x01"


def test_calls_whose_message_never_comes_are_refused_and_counted(served: Any) -> None:
    engine, channel = served
    never = threading.Event()

    def silent() -> Iterator[bytes]:
        never.wait(20)
        yield b""

    call = channel.stream_unary(f"/{SERVICE}/GetCoverage")
    before = ended_without_message(engine)
    with pytest.raises(grpc.RpcError) as caught:
        call(iter([]), timeout=20)
    assert caught.value.code() == grpc.StatusCode.INVALID_ARGUMENT
    assert call.future(silent(), timeout=0.2).exception(timeout=20) is not None
    never.set()
    until = time.monotonic() + 10
    while ended_without_message(engine) < before + 2 and time.monotonic() < until:
        time.sleep(0.01)
    assert ended_without_message(engine) == before + 2


def ended_without_message(engine: Engine) -> float:
    return counted(engine, "GetCoverage") + counted(engine, "GetCoverage", code="CANCELLED")
