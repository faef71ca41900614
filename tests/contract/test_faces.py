"""The same request gets the same answer through every face, over real sockets."""

import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import grpc
import httpx
import numpy as np
import pytest
from google.protobuf.json_format import MessageToDict

from service.geometry.camera import PinholeCamera
from service.geometry.distortion import rays_of
from service.grpc.generated.streetfix.v1 import localization_pb2 as pb
from service.grpc.generated.streetfix.v1.localization_pb2_grpc import LocalizationServiceStub

Parts = Callable[..., dict[str, bytes]]
CAMERA = pb.Camera(width=64, height=48, fx=32, fy=32, cx=31.5, cy=23.5)
DEPTH = pb.DepthFormat(scale_m=1)
#: Where the second of two frames stood: the camera 1 m further along its optical axis.
AHEAD = {"position": {"x": 0.0, "y": 0.0, "z": 1.0}, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}


@pytest.fixture(scope="module")
def faces(bundle_path: Path, serving: Any) -> Iterator[tuple[httpx.Client, LocalizationServiceStub]]:
    """REST and gRPC on one engine."""
    with serving(bundle_path) as (client, stub, _):
        yield client, stub


def flat(answer: dict[str, Any]) -> dict[str, Any]:
    """An answer of either face with the other's spelling taken off: no times, no nulls, no empty lists, one name for a value."""

    def plain(value: Any) -> Any:
        if isinstance(value, dict):
            return {
                k: plain(v) for k, v in value.items() if v not in (None, [], {}) and k not in ("timings", "timings_ms")
            }
        if isinstance(value, list):
            return [plain(each) for each in value]
        if isinstance(value, str):
            for prefix in ("LOCALIZATION_STATUS_", "STREET_SECTION_", "CAMERA_HEIGHT_ORIGIN_", "CALIBRATION_RANGE_"):
                value = value.removeprefix(prefix)
            return value.lower()
        return float(value) if isinstance(value, int) else value

    return plain(answer)


def of_message(message: pb.LocalizeResponse) -> dict[str, Any]:
    return flat(MessageToDict(message, preserving_proto_field_name=True, always_print_fields_with_no_presence=True))


def posted(client: httpx.Client, path: str, parts: dict[str, bytes]) -> Any:
    response = client.post(path, files={name: (name, data) for name, data in parts.items()})
    assert response.status_code == 200, response.text
    return response.json()


def pair(parts: dict[str, bytes]) -> dict[str, Any]:
    return {"rgb": parts["rgb"], "depth": parts["depth"]}


def numbered(parts: dict[str, bytes], count: int, document: dict[str, Any]) -> dict[str, bytes]:
    pictures = {f"{name}{k}": parts[name] for k in range(count) for name in ("rgb", "depth")}
    return pictures | {"request": json.dumps(document).encode()}


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({}, {}),
        ({"options": {"refine": False, "neighbours": 3}}, {"options": pb.Options(refine=False, neighbours=3)}),
        ({"gravity": {"x": 0.02, "y": 1, "z": 0}}, {"gravity": pb.Vector3(x=0.02, y=1)}),
        ({"T_vehicle_camera": AHEAD}, {"vehicle_from_camera": AHEAD}),
        (
            {"T_vehicle_camera": AHEAD | {"position": {"x": 0, "y": 0, "z": 1.6}}, "vehicle_base_on_ground": True},
            {"vehicle_from_camera": AHEAD | {"position": {"x": 0, "y": 0, "z": 1.6}}, "vehicle_base_on_ground": True},
        ),
        (
            {
                "camera": {
                    "width": 64,
                    "height": 48,
                    "fx": 32,
                    "fy": 32,
                    "cx": 31.5,
                    "cy": 23.5,
                    "height_m": 1.52,
                    "height_std_m": 0.02,
                }
            },
            {
                "camera": pb.Camera(
                    width=64, height=48, fx=32, fy=32, cx=31.5, cy=23.5, height_m=1.52, height_std_m=0.02
                )
            },
        ),
        (
            {"map": "tiny", "prior": {"position": {"x": 20, "y": 2}, "heading_deg": 90}},
            {"map": "tiny", "prior": pb.Prior(position=pb.PriorPosition(x=20, y=2), heading_deg=90)},
        ),
    ],
)
def test_one_pair(faces: Any, parts_of: Parts, changed: dict[str, Any], message: dict[str, Any]) -> None:
    client, stub = faces
    parts = parts_of(**changed)
    rest = posted(client, "/v1/localize", parts)
    request = pb.LocalizeRequest(**pair(parts), **{"camera": CAMERA, "depth_format": DEPTH} | message)
    assert of_message(stub.Localize(request)) == flat(rest)
    assert rest["pose"]["position"]["x"] == pytest.approx(20, abs=0.3)
    is_given = "vehicle_base_on_ground" in changed or "camera" in changed
    assert rest["camera_height"]["origin"] == ("given" if is_given else "estimated")
    assert rest["camera_height"]["height_m"] == pytest.approx(1.5, abs=0.1)


#: The lens, its number in the proto, and how far it may move the answer, metres.
LENSES = [
    (PinholeCamera(128, 96, 64.0, 64.0, 63.5, 47.5, (-0.1, 0.02, 0.001, 0.0, 0.0)), pb.DISTORTION_MODEL_BROWN_CONRADY),
    (
        PinholeCamera(128, 96, 80.0, 80.0, 63.5, 47.5, (0.01, 0.0, 0.0, 0.0), "kannala_brandt"),
        pb.DISTORTION_MODEL_KANNALA_BRANDT,
    ),
]


@pytest.mark.parametrize(("lens", "number"), LENSES, ids=lambda each: getattr(each, "distortion_model", ""))
@pytest.mark.parametrize("kind", ["z", "range"])
def test_a_pair_through_a_lens(
    faces: Any, parts_of: Parts, pictures_through: Any, png_and_npy: Any, lens: PinholeCamera, number: int, kind: Any
) -> None:
    """Both faces rectify the same images to the same answer, near that of the pinhole camera."""
    client, stub = faces
    rgb, depth_m = pictures_through(lens)
    if kind == "range":
        pixels = np.stack(np.meshgrid(np.arange(lens.width), np.arange(lens.height)), axis=-1)
        depth_m = (depth_m / rays_of(lens, pixels.astype(np.float64))[..., 2]).astype(np.float32)
    names = ("width", "height", "fx", "fy", "cx", "cy", "distortion_model")
    camera = {name: getattr(lens, name) for name in names} | {"distortion": list(lens.distortion)}
    document = {"camera": camera, "depth": {"scale_m": 1, "kind": kind}}
    parts = png_and_npy(rgb, depth_m) | {"request": json.dumps(document).encode()}
    rest = posted(client, "/v1/localize", parts)
    message = pb.Camera(**camera | {"distortion_model": number})
    depth_format = pb.DepthFormat(scale_m=1, kind=pb.DEPTH_KIND_RANGE if kind == "range" else pb.DEPTH_KIND_Z)
    request = pb.LocalizeRequest(**pair(parts), camera=message, depth_format=depth_format)
    assert of_message(stub.Localize(request)) == flat(rest)
    plain = posted(client, "/v1/localize", parts_of())
    # Along this street of flat walls the standard deviation is 1 m.
    for axis, within_m in (("x", 0.2), ("y", 0.1), ("z", 0.1)):
        assert rest["pose"]["position"][axis] == pytest.approx(plain["pose"]["position"][axis], abs=within_m)
    assert rest["camera_height"]["height_m"] == pytest.approx(1.5, abs=0.1)


@pytest.mark.parametrize("distortion", [[0.0], [0.0] * 4, [0.0] * 14])
def test_zero_coefficients_give_the_answer_of_no_distortion(
    faces: Any, parts_of: Parts, distortion: list[float]
) -> None:
    client, stub = faces
    parts = parts_of()
    plain = posted(client, "/v1/localize", parts)
    document = json.loads(parts["request"])
    document["camera"]["distortion"] = distortion
    rest = posted(client, "/v1/localize", parts | {"request": json.dumps(document).encode()})
    assert flat(rest) == flat(plain)
    bent = pb.Camera(distortion=distortion)
    bent.MergeFrom(CAMERA)
    assert of_message(stub.Localize(pb.LocalizeRequest(**pair(parts), camera=bent, depth_format=DEPTH))) == flat(plain)


@pytest.mark.parametrize(
    ("lens", "text"),
    [({"distortion": [-0.3, 0, 0, 0]}, "stops growing"), ({"distortion": [0.1]}, "does not have 1 coefficients")],
)
def test_a_wrong_lens_is_refused_with_the_same_words(faces: Any, parts_of: Parts, lens: Any, text: str) -> None:
    client, stub = faces
    parts = parts_of()
    document = json.loads(parts["request"])
    document["camera"] |= lens
    parts |= {"request": json.dumps(document).encode()}
    problem = client.post("/v1/localize", files={name: (name, data) for name, data in parts.items()}).json()
    assert (problem["code"], problem["field"]) == ("request", "camera.distortion")
    assert text in problem["detail"]
    bent = pb.Camera(**lens)
    bent.MergeFrom(CAMERA)
    with pytest.raises(grpc.RpcError) as caught:
        stub.Localize(pb.LocalizeRequest(**pair(parts), camera=bent, depth_format=DEPTH))
    assert caught.value.details() == problem["detail"]


def test_a_sequence(faces: Any, parts_of: Parts) -> None:
    client, stub = faces
    parts = parts_of()
    request = json.loads(parts["request"])
    frames = [request, request | {"T_reference_camera": AHEAD}]
    rest = posted(client, "/v1/localize/sequence", numbered(parts, 2, {"map": "tiny", "frames": frames}))
    message = pb.SequenceFrame(**pair(parts), camera=CAMERA, depth_format=DEPTH)
    ahead = pb.SequenceFrame(**pair(parts), camera=CAMERA, depth_format=DEPTH, reference_from_camera=AHEAD)
    answer = stub.LocalizeSequence(pb.LocalizeSequenceRequest(map="tiny", frames=[message, ahead])).answer
    assert of_message(answer) == flat(rest)
    alone = posted(client, "/v1/localize", parts)
    assert rest["pose"]["covariance"] != alone["pose"]["covariance"]  # the second frame had its say


def test_a_batch_answers_each_on_its_own(faces: Any, parts_of: Parts) -> None:
    client, stub = faces
    parts = parts_of()
    good, lost = json.loads(parts["request"]), json.loads(parts["request"]) | {"map": "west"}
    before = batches(client)
    rest = posted(client, "/v1/localize/batch", numbered(parts, 2, {"requests": [good, lost]}))["outcomes"]
    message = pb.LocalizeRequest(**pair(parts), camera=CAMERA, depth_format=DEPTH)
    elsewhere = pb.LocalizeRequest(**pair(parts), camera=CAMERA, depth_format=DEPTH, map="west")
    outcomes = stub.LocalizeBatch(pb.LocalizeBatchRequest(requests=[message, elsewhere])).outcomes
    assert of_message(outcomes[0].answer) == flat(rest[0]["answer"]) == flat(posted(client, "/v1/localize", parts))
    assert (rest[0]["problem"], rest[1]["answer"]) == (None, None)
    problem, other = rest[1]["problem"], outcomes[1].problem
    assert (other.code, other.title, other.detail, other.field) == tuple(
        problem[name] for name in ("code", "title", "detail", "field")
    )
    assert (problem["code"], problem["field"], problem["status"]) == ("unknown-map", "requests.1.map", 404)
    assert batches(client) == (before[0] + 2, before[1] + 4)


def batches(client: httpx.Client) -> tuple[float, float]:
    """How many batches came, of how many requests."""
    text = client.get("/metrics").text
    found = dict(re.findall(r"^streetfix_batch_size_(count|sum) (\S+)$", text, re.MULTILINE))
    return float(found["count"]), float(found["sum"])


def test_a_stream_is_a_sequence_that_grows(faces: Any, parts_of: Parts) -> None:
    client, stub = faces
    parts = parts_of()
    frame = pb.LocalizeRequest(**pair(parts), camera=CAMERA, depth_format=DEPTH)

    def drive() -> Iterator[pb.LocalizeStreamRequest]:
        yield pb.LocalizeStreamRequest(frame=frame)
        yield pb.LocalizeStreamRequest(frame=frame, previous_from_camera=AHEAD)
        yield pb.LocalizeStreamRequest(frame=pb.LocalizeRequest(camera=CAMERA), previous_from_camera=AHEAD)
        yield pb.LocalizeStreamRequest(frame=frame, previous_from_camera=AHEAD)
        yield pb.LocalizeStreamRequest(frame=frame)

    answers = list(stub.LocalizeStream(drive()))
    assert [answer.frames for answer in answers] == [1, 2, 0, 1, 1]
    assert answers[2].outcome.problem.field == "frame 2.rgb"
    alone = flat(posted(client, "/v1/localize", parts))
    assert [of_message(answers[k].outcome.answer) == alone for k in (0, 1, 3, 4)] == [True, False, True, True]
    # From the newer frame the older one stood 1 m behind.
    behind = AHEAD | {"position": {"x": 0.0, "y": 0.0, "z": -1.0}}
    request = json.loads(parts["request"])
    document = {"frames": [request, request | {"T_reference_camera": behind}]}
    rest = posted(client, "/v1/localize/sequence", numbered(parts, 2, document))
    assert of_message(answers[1].outcome.answer) == flat(rest)


def test_a_stream_remembers_five_frames(faces: Any, parts_of: Parts) -> None:
    _, stub = faces
    frame = pb.LocalizeRequest(**pair(parts_of()), camera=CAMERA, depth_format=DEPTH)
    requests = [pb.LocalizeStreamRequest(frame=frame, previous_from_camera=AHEAD if k else None) for k in range(7)]
    assert [answer.frames for answer in stub.LocalizeStream(iter(requests))] == [1, 2, 3, 4, 5, 5, 5]


def test_maps_streets_and_coverage(faces: Any) -> None:
    client, stub = faces
    maps = client.get("/v1/maps").json()["maps"]
    listed = [
        MessageToDict(entry, preserving_proto_field_name=True, always_print_fields_with_no_presence=True)
        for entry in stub.ListMaps(pb.ListMapsRequest()).maps
    ]
    assert listed == maps
    assert stub.GetStreets(pb.GetStreetsRequest(map="tiny")).geojson == client.get("/v1/maps/tiny/streets").content
    coverage = client.get("/v1/coverage")
    assert stub.GetCoverage(pb.GetCoverageRequest()).geojson == coverage.content
    assert stub.GetCoverage(pb.GetCoverageRequest(map="tiny")).geojson == coverage.content
    assert coverage.headers["content-type"] == "application/geo+json"
    (feature,) = coverage.json()["features"]
    assert (feature["properties"]["map"], feature["geometry"]["type"]) == ("tiny", "MultiPolygon")
