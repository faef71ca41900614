"""Arbitrary bytes as messages of every gRPC call to a real server; no call may end in UNKNOWN or INTERNAL."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import grpc
from grpc_reflection.v1alpha import reflection_pb2

from service.grpc.generated.streetfix.v1 import localization_pb2 as pb
from service.grpc.reading import SERVICE
from service.grpc.server import HEALTH, GrpcServer
from service.runtime.engine import Engine
from service.runtime.settings import Limits, Settings

_REFLECTION = reflection_pb2.DESCRIPTOR.services_by_name["ServerReflection"].full_name
#: Every call of the server. The first byte of an input chooses one.
METHODS = (
    *(f"/{SERVICE}/{name}" for name in pb.DESCRIPTOR.services_by_name["LocalizationService"].methods_by_name),
    f"/{HEALTH}/Check",
    f"/{HEALTH}/Watch",
    f"/{_REFLECTION}/ServerReflectionInfo",
)
#: Allowed status codes.
_ANSWERS = {
    grpc.StatusCode.OK,
    grpc.StatusCode.INVALID_ARGUMENT,
    grpc.StatusCode.NOT_FOUND,
    grpc.StatusCode.OUT_OF_RANGE,
    grpc.StatusCode.UNIMPLEMENTED,
}
_DEADLINE_S = 60.0


class GrpcCalls:
    """A server of a small map, and a client that sends bytes.

    Args:
        bundle: the map.
    """

    def __init__(self, bundle: Path) -> None:
        limits = Limits(max_part_bytes=2**20, max_pixels=2**20)
        self._engine = Engine.open(Settings(maps=(bundle,), threads=1, limits=limits))
        self._server = GrpcServer(self._engine, host="127.0.0.1", port=0)
        self._server.start()
        channel = grpc.insecure_channel(f"127.0.0.1:{self._server.port}")
        self._calls = [channel.stream_stream(method, bytes, bytes) for method in METHODS]

    def take(self, data: bytes) -> None:
        """Send the bytes as the message of a call; a streaming call gets them twice.

        Args:
            data: the first byte chooses the call, the rest is the message.

        Raises:
            AssertionError: the call ended with a status that is not allowed for a bad request.
        """
        if not data:
            return
        number = data[0] % len(METHODS)
        messages = [data[1:]] * (2 if METHODS[number].endswith("Stream") else 1)
        code = _ended(self._calls[number](iter(messages), timeout=_DEADLINE_S))
        if code not in _ANSWERS:
            raise AssertionError(f"{METHODS[number]} ended with {code}")


def _ended(call: Iterable[bytes]) -> grpc.StatusCode:
    try:
        for _ in call:
            pass
    except grpc.RpcError as error:
        code: grpc.StatusCode = error.code()
        return code
    return grpc.StatusCode.OK


def _seeds() -> Iterator[bytes]:
    frame: dict[str, Any] = {
        "rgb": b"1",
        "depth": b"2",
        "camera": pb.Camera(width=64, height=48, fx=32, fy=32, cx=31.5, cy=23.5, height_m=0.3),
        "depth_format": pb.DepthFormat(scale_m=0.001, kind=pb.DEPTH_KIND_DISPARITY, baseline_m=0.1, max_range_m=40.0),
        "gravity": pb.Vector3(y=9.8),
    }
    about: dict[str, Any] = {
        "map": "tiny",
        "options": pb.Options(refine=True, neighbours=5),
        "vehicle_from_camera": pb.RigidTransform(position=pb.Vector3(z=1), orientation=pb.Quaternion(w=1)),
        "vehicle_base_on_ground": True,
        "prior": pb.Prior(position=pb.PriorPosition(x=1, y=2, std_m=3), heading_deg=10),
    }
    request = pb.LocalizeRequest(**frame, **about)
    behind = pb.RigidTransform(position=pb.Vector3(z=-1), orientation=pb.Quaternion(w=1))
    second = pb.SequenceFrame(**frame, reference_from_camera=behind)
    messages = {
        "Localize": request,
        "LocalizeBatch": pb.LocalizeBatchRequest(requests=[request, request]),
        "LocalizeSequence": pb.LocalizeSequenceRequest(frames=[pb.SequenceFrame(**frame), second], **about),
        "LocalizeStream": pb.LocalizeStreamRequest(frame=request, previous_from_camera=behind),
        "GetStreets": pb.GetStreetsRequest(map="tiny"),
        "GetCoverage": pb.GetCoverageRequest(map="tiny"),
        "ServerReflectionInfo": reflection_pb2.ServerReflectionRequest(file_containing_symbol=SERVICE),
    }
    for number, method in enumerate(METHODS):
        message = messages.get(method.rpartition("/")[2])
        yield bytes([number]) + (b"" if message is None else message.SerializeToString())


#: A valid message of each call, after the call's number.
SEEDS = tuple(_seeds())
