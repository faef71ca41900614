"""The gRPC client against a fake servicer over a real channel, and every way a call can end."""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import grpc
import numpy as np
import pytest
from google.rpc import code_pb2
from grpc_status import rpc_status

from service.client import Frame, GrpcClient, Options, PinholeCamera, Prior, PriorPosition, Track
from service.client.grpc_errors import errors_of_grpc
from service.client.grpc_messages import answer_of
from service.client.retry import RetryPolicy
from service.contract import schema
from service.errors import (
    BusyError,
    DeadlineError,
    ForeignServiceError,
    ImageSizeError,
    NoAnswerInTimeError,
    NotReadyError,
    RefusedError,
    RequestError,
    StreetfixError,
    TooLargeError,
    UnauthorizedError,
    UnavailableError,
    UnknownMapError,
    UnreachableError,
)
from service.geometry.camera import DistortionModel
from service.grpc.generated.streetfix.v1 import localization_pb2 as pb
from service.grpc.generated.streetfix.v1.localization_pb2_grpc import (
    LocalizationServiceServicer,
    add_LocalizationServiceServicer_to_server,
)
from service.grpc.messages import answer_message, request_from, sequence_request_from
from service.grpc.status import status_of

RGB, DEPTH = np.full((4, 6, 3), 7, np.uint8), np.full((4, 6), 2.5, np.float32)
CAMERA = PinholeCamera(6, 4, 3.0, 3.0, 2.5, 1.5)
ORIGIN = {"x": 0, "y": 0, "z": 0}
POSE = {"position": ORIGIN, "orientation": ORIGIN | {"w": 1}, "heading_deg": 180.0, "covariance": None}
Json = Callable[..., dict[str, Any]]


class Told(LocalizationServiceServicer):
    """Answers every call with the next of ``answers``: a message, a service error, or a status code with details."""

    def __init__(self) -> None:
        self.answers: list[Any] = []
        self.asked: list[Any] = []
        self.metadata: dict[str, Any] = {}

    def _next(self, request: Any, context: grpc.ServicerContext) -> Any:
        self.asked.append(request)
        self.metadata = dict(context.invocation_metadata())
        context.send_initial_metadata((("x-request-id", "r1"),))
        answer = self.answers.pop(0)
        if isinstance(answer, StreetfixError):
            context.abort_with_status(rpc_status.to_status(status_of(answer)))
        if isinstance(answer, tuple):
            context.abort(*answer)
        return answer

    Localize = LocalizeSequence = LocalizeBatch = ListMaps = GetStreets = GetCoverage = _next


@pytest.fixture(scope="module")
def served() -> Iterator[tuple[Told, str]]:
    told = Told()
    server = grpc.server(ThreadPoolExecutor(2))
    add_LocalizationServiceServicer_to_server(told, server)
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    yield told, f"127.0.0.1:{port}"
    server.stop(None).wait()


@pytest.fixture
def told(served: tuple[Told, str]) -> Told:
    served[0].answers, served[0].asked = [], []
    return served[0]


@pytest.fixture
def waited_s() -> list[float]:
    return []


@pytest.fixture
def client(served: tuple[Told, str], waited_s: list[float]) -> Iterator[GrpcClient]:
    with GrpcClient(served[1], api_key="k", sleep=waited_s.append, draw=lambda: 0.0) as client:
        yield client


def test_a_request_is_read_by_the_service_as_written(client: GrpcClient, told: Told, answer_json: Json) -> None:
    told.answers = [answer_message(schema.LocalizeAnswer.model_validate(answer_json()))]
    T = np.eye(4)
    T[:3, 3] = (1.0, 2.0, 3.0)
    client.localize(
        RGB,
        DEPTH,
        CAMERA,
        map="m",
        gravity=[0.0, 1.0, 0.0],
        T_vehicle_camera=T,
        options=Options(refine=False),
        max_range_m=40.0,
        prior=Prior(position=PriorPosition(x=1.0, y=2.0, std_m=3.0), heading_deg=90.0),
        camera_height_m=0.3,
        camera_height_std_m=0.02,
        vehicle_base_on_ground=True,
    )
    read = request_from(told.asked[0])
    assert (read.map, read.options.refine, read.depth.max_range_m, read.depth.scale_m) == ("m", False, 40.0, 0.001)
    assert read.gravity == schema.Direction(x=0, y=1, z=0)
    assert read.T_vehicle_camera is not None
    assert read.T_vehicle_camera.position == schema.Position(x=1, y=2, z=3)
    assert read.prior == Prior(position=PriorPosition(x=1.0, y=2.0, std_m=3.0), heading_deg=90.0, heading_std_deg=20.0)
    assert (read.camera.fx, read.camera.height_m, read.camera.height_std_m) == (3.0, 0.3, 0.02)
    assert read.vehicle_base_on_ground
    assert told.asked[0].depth.startswith(b"SFD1")
    assert told.metadata["authorization"] == "Bearer k"
    assert told.metadata["x-streetfix-cell"] == "m-map-0-0"


@pytest.mark.parametrize(
    ("distortion", "model"),
    [
        ((), "brown_conrady"),
        ((-0.3, 0.1, 0.0, 0.0), "brown_conrady"),
        ((0.0, 0.0, 0.0, 0.0), "kannala_brandt"),
    ],
)
def test_the_lens_is_read_by_the_service_as_written(
    client: GrpcClient, told: Told, answer_json: Json, distortion: tuple[float, ...], model: DistortionModel
) -> None:
    told.answers = [answer_message(schema.LocalizeAnswer.model_validate(answer_json()))]
    client.localize(RGB, DEPTH, replace(CAMERA, distortion=distortion, distortion_model=model))
    read = request_from(told.asked[0]).camera
    assert (tuple(read.distortion), read.distortion_model) == (distortion, model)


def test_a_lens_of_another_enum_value_is_refused() -> None:
    message = pb.LocalizeRequest(camera=pb.Camera(width=64, height=48, fx=32, fy=32, cx=31.5, cy=23.5))
    message.camera.distortion_model = 7  # type: ignore[assignment]  # a later client may know more lenses
    with pytest.raises(
        RequestError, match=r"camera.distortion_model: Input should be 'brown_conrady' or 'kannala_brandt'"
    ):
        request_from(message)


@pytest.mark.parametrize(
    "changed",
    [
        {},
        {"status": "OUT_OF_MAP"},
        {"status": "AMBIGUOUS", "hypotheses": []},
        {"street": {"id": "s", "name": "N", "street": "1", "section": None, "class_index": 0, "vote": 1.0}},
        {
            "geopose": {
                "position": {"lat": 52.5, "lon": 13.4, "h": 70.0},
                "quaternion": {"x": 0, "y": 0, "z": 0, "w": 1},
            }
        },
        {"vehicle_pose": POSE},
        {"camera_height": {"height_m": 0.3, "origin": "given"}},
        {"calibration": "in_range"},
        {"calibration": "extrapolated", "extrapolated": {"front": 5.25, "points": -4.5}},
        {"threshold": {"confidence": 0.9, "false_accept_rate": 0.01}},
        {"rig_correction": "mule"},
        {"status": "AMBIGUOUS", "camera_height": {"height_m": 1.5, "origin": "assumed"}},
        {"hypotheses": [{"confirmed": True, "pose": POSE, "share": 1, "inliers": 0.5, "similarity": 0.25}]},
        {
            "neighbours": [
                {"place": 3, "distance": 0.5, "similarity": 0.5, "street": None, "position": ORIGIN, "heading_deg": 0.0}
            ]
        },
    ],
)
def test_an_answer_comes_through_the_messages_as_it_was(
    answer_json: Json, refused_of: Json, changed: dict[str, Any]
) -> None:
    content = refused_of(answer_json(), **changed) if "status" in changed else answer_json(**changed)
    answer = schema.LocalizeAnswer.model_validate(content)
    message = answer_message(answer)
    assert answer_of(message) == answer
    assert message.HasField("pose") == (answer.status == "LOCALIZED")


def test_a_sequence_and_a_batch(client: GrpcClient, told: Told, answer_json: Json) -> None:
    answer = schema.LocalizeAnswer.model_validate(answer_json())
    refusal = pb.Problem(code="no-depth", title="T.", detail="D", field="requests.1.depth")
    told.answers = [
        pb.LocalizeSequenceResponse(answer=answer_message(answer)),
        pb.LocalizeBatchResponse(outcomes=[pb.Outcome(answer=answer_message(answer)), pb.Outcome(problem=refusal)]),
    ]
    frames = [Frame(rgb=RGB, depth=DEPTH, camera=CAMERA, T_reference_camera=T) for T in (None, np.eye(4))]
    assert client.localize_sequence(frames) == answer
    read = sequence_request_from(told.asked[0])
    assert (read.vehicle_base_on_ground, read.frames[0].camera.height_m) == (False, None)
    assert [frame.T_reference_camera is None for frame in read.frames] == [True, False]
    first, second = client.localize_batch([Frame(rgb=RGB, depth=DEPTH, camera=CAMERA)] * 2)
    assert first == answer
    assert isinstance(second, RefusedError)
    assert (second.problem, second.field) == ("no-depth", "requests.1.depth")


def test_maps_streets_and_coverage(client: GrpcClient, told: Told) -> None:
    entry = pb.MapEntry(name="m", version="v", made_at="2026", places=1, versions=["v", "u"], spacing_m=2.0)
    collection = b'{"type": "FeatureCollection", "features": []}'
    told.answers = [
        pb.ListMapsResponse(maps=[entry]),
        pb.GetStreetsResponse(geojson=collection),
        pb.GetCoverageResponse(geojson=collection),
    ]
    (found,) = client.maps()
    assert (found.name, found.versions, found.spacing_m) == ("m", ["v", "u"], 2.0)
    assert client.streets("m") == client.coverage() == {"type": "FeatureCollection", "features": []}
    assert told.asked[1].map == "m"


@pytest.mark.parametrize(
    "error",
    [
        ImageSizeError("w", field="rgb"),
        TooLargeError("w"),
        UnknownMapError("w"),
        UnauthorizedError("w"),
        DeadlineError("w"),
    ],
    ids=lambda error: error.code,
)
def test_a_problem_is_reported_after_one_request(client: GrpcClient, told: Told, error: StreetfixError) -> None:
    told.answers = [error]
    with pytest.raises(RefusedError) as caught:
        client.maps()
    got = caught.value
    assert (got.problem, got.detail, got.field, got.request_id) == (error.code, "w", error.field, "r1")
    assert not isinstance(got, UnavailableError)


@pytest.mark.parametrize("error", [BusyError("w"), NotReadyError("w")], ids=lambda error: error.code)
def test_a_refusal_with_a_retry_time_is_repeated_then(
    client: GrpcClient, told: Told, waited_s: list[float], error: StreetfixError
) -> None:
    told.answers = [error, error, pb.ListMapsResponse()]
    assert client.maps() == []
    assert waited_s == [1.0, 1.0]


def test_a_service_that_stays_busy_is_reported(served: tuple[Told, str], told: Told) -> None:
    told.answers = [BusyError("w")]
    with GrpcClient(served[1], retry=RetryPolicy(attempts=1)) as client, pytest.raises(UnavailableError) as caught:
        client.maps()
    assert (caught.value.status, caught.value.retry_after_s) == ("RESOURCE_EXHAUSTED", 1.0)


KIND_OF_CODE = {
    grpc.StatusCode.DEADLINE_EXCEEDED: NoAnswerInTimeError,
    grpc.StatusCode.UNAVAILABLE: UnreachableError,
    grpc.StatusCode.CANCELLED: UnreachableError,
    grpc.StatusCode.UNIMPLEMENTED: ForeignServiceError,
    grpc.StatusCode.UNKNOWN: ForeignServiceError,
}


@pytest.mark.parametrize(
    "code", [code for code in grpc.StatusCode if code != grpc.StatusCode.OK], ids=lambda code: code.name
)
def test_every_code_without_details_is_one_of_our_errors(
    served: tuple[Told, str], told: Told, code: grpc.StatusCode
) -> None:
    told.answers = [(code, "why")]
    with GrpcClient(served[1], retry=RetryPolicy(attempts=1)) as client, pytest.raises(StreetfixError) as caught:
        client.maps()
    assert type(caught.value) is KIND_OF_CODE.get(code, RefusedError)


def test_a_message_beyond_grpcs_limit_is_not_sent_again(client: GrpcClient, told: Told, waited_s: list[float]) -> None:
    told.answers = [(grpc.StatusCode.RESOURCE_EXHAUSTED, "larger than max")]
    with pytest.raises(RefusedError, match="larger than max"):
        client.maps()
    assert waited_s == []


def test_details_that_contradict_their_call_are_no_problem_of_ours() -> None:
    class Odd(grpc.RpcError, grpc.Call):  # as grpc's own errors are made
        def code(self) -> grpc.StatusCode:
            return grpc.StatusCode.NOT_FOUND

        def details(self) -> str:
            return "words"

        def initial_metadata(self) -> Any:
            return ()

        def trailing_metadata(self) -> Any:
            from google.rpc import status_pb2

            status = status_pb2.Status(code=code_pb2.ABORTED, message="other words")
            return (("grpc-status-details-bin", status.SerializeToString()),)

    Odd.__abstractmethods__ = frozenset()  # type: ignore[attr-defined]  # the rest of a call is not asked for
    with pytest.raises(RefusedError, match="words"), errors_of_grpc("x:1", 1.0, None):
        raise Odd


def test_an_error_that_is_no_call_is_one_of_ours() -> None:
    with pytest.raises(UnreachableError), errors_of_grpc("x:1", 1.0, None):
        raise grpc.RpcError("gone")


def test_an_answer_of_another_contract_is_reported(client: GrpcClient, told: Told) -> None:
    told.answers = [pb.LocalizeResponse(status=99)]  # type: ignore[arg-type]  # a later contract's
    with pytest.raises(ForeignServiceError, match="another contract"):
        client.localize(RGB, DEPTH, CAMERA)


@pytest.mark.parametrize("address", ["", "localhost", "http://x:1", ":1", "x:y"])
def test_an_address_that_is_none_is_refused(address: str) -> None:
    with pytest.raises(RequestError, match="pass HOST:PORT"):
        GrpcClient(address)


@pytest.mark.parametrize("timeout_s", [0.0, float("nan")])
def test_a_time_that_is_none_is_refused(timeout_s: float) -> None:
    with pytest.raises(RequestError, match="timeout_s"):
        GrpcClient("x:1", timeout_s=timeout_s)


def test_sequences_and_batches_have_the_cell_of_their_first_prior_and_other_calls_have_none(
    client: GrpcClient, told: Told, answer_json: Json
) -> None:
    answer = answer_message(schema.LocalizeAnswer.model_validate(answer_json()))
    first = Frame(rgb=RGB, depth=DEPTH, camera=CAMERA)
    frames = [first, replace(first, T_reference_camera=np.eye(4))]
    prior = Prior(position=PriorPosition(x=-1.0, y=2500.0, std_m=3.0))
    told.answers = [
        pb.LocalizeSequenceResponse(answer=answer),
        pb.LocalizeBatchResponse(outcomes=[pb.Outcome(answer=answer)]),
        pb.ListMapsResponse(),
    ]
    cells = []
    for call in (
        lambda: client.localize_sequence(frames, map="m", prior=prior),
        lambda: client.localize_batch(frames[:1], map="m", prior=prior),
        client.maps,
    ):
        call()
        cells.append(told.metadata.get("x-streetfix-cell"))
    assert cells == ["m-map--1-2", "m-map--1-2", None]


def test_a_track_without_a_prior_has_the_cell_of_its_last_answer(
    client: GrpcClient, told: Told, answer_json: Json
) -> None:
    pose = POSE | {"position": {"x": 1200.0, "y": 3.0, "z": 0.0}}
    modes = [{"pose": pose, "weight": 0.9, "number": 0, "unseen": 0}]
    belief = {"epoch": 0, "modes": modes, "elsewhere": 0.1, "outside": 0.0, "token": "t"}
    before = schema.LocalizeAnswer.model_validate(answer_json(pose=pose, belief=belief))
    told.answers = [answer_message(before)]
    client.localize(RGB, DEPTH, CAMERA, map="m", track=Track(before=before, T_previous_camera=np.eye(4)))
    assert told.metadata["x-streetfix-cell"] == "m-map-1-0"
