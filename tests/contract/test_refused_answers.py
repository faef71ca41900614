"""An answer that is not LOCALIZED carries no pose, whatever face and call it comes through. A real map refuses here."""

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import httpx
import numpy as np
import pytest

from service.client import Client, GrpcClient, NotLocalizedError, Options
from service.confidence.features import FEATURES
from service.contract.schema import LocalizeAnswer
from service.grpc.generated.streetfix.v1 import localization_pb2 as pb
from service.grpc.generated.streetfix.v1.localization_pb2_grpc import LocalizationServiceStub
from service.maps.content import BundleContent
from service.maps.writer import write_bundle

Parts = Callable[..., dict[str, bytes]]
NONE = ("pose", "vehicle_pose", "geopose", "street")
CAMERA = pb.Camera(width=64, height=48, fx=32, fy=32, cx=31.5, cy=23.5)
#: Less than the map's confidence in any answer, a half, allows.
STRICT, LENIENT = 0.001, 0.01
VEHICLE = {"position": {"x": 0.0, "y": 0.0, "z": 0.5}, "orientation": {"x": -0.5, "y": 0.5, "z": -0.5, "w": 0.5}}


def calibration(*, known: float) -> dict[str, Any]:
    """A calibration that is right in half of the cases; a rate of ``STRICT`` refuses its answers, ``LENIENT`` accepts them."""
    flat: dict[str, Any] = {"terms": []}
    thresholds = ((STRICT, 0.9), (LENIENT, 0.4))
    return {
        "calibrated": True,
        "features": [{"name": name, "mean": 0.0, "std": 1.0} for name in FEATURES],
        "right": flat | {"bias": 0.0},
        "known": flat | {"bias": known},
        "thresholds": [{"false_accept_rate": rate, "confidence": confidence} for rate, confidence in thresholds],
        "site": None,
        "measured_on": {"cities": "none", "queries": 0},
    }


@pytest.fixture(scope="module", params=["AMBIGUOUS", "OUT_OF_MAP"])
def refusing(
    request: pytest.FixtureRequest,
    content_of: Callable[..., BundleContent],
    tmp_path_factory: pytest.TempPathFactory,
    serving: Any,
) -> Iterator[Any]:
    """Both faces over a map on the Earth that answers a strict question with the status of the parameter."""
    folder: Path = tmp_path_factory.mktemp("refusing") / "tiny"
    write_bundle(
        folder,
        content_of(
            calibration=calibration(known=1.0 if request.param == "AMBIGUOUS" else -1.0),
            georeference={"latitude_deg": 48.0, "longitude_deg": 11.0, "height_m": 500.0},
        ),
    )
    with serving(folder, false_accept_rate=STRICT) as (client, stub, address):
        yield SimpleNamespace(status=request.param, client=client, stub=stub, url=str(client.base_url), address=address)


def posted(client: httpx.Client, path: str, parts: dict[str, bytes], **headers: str) -> httpx.Response:
    return client.post(path, files={name: (name, data) for name, data in parts.items()}, headers=headers)


def require_refused(answer: dict[str, Any], status: str) -> None:
    assert answer["status"] == status
    assert {name: answer[name] for name in NONE} == dict.fromkeys(NONE)
    assert answer["confidence"] == pytest.approx(0.5)
    assert answer["map"]["name"] == "tiny"
    assert answer["hypotheses"], "the candidates are kept"
    assert not any(each["confirmed"] for each in answer["hypotheses"])
    assert answer["reasons"], "evidence lies far from this calibration's means of 0"
    assert all(each["evidence"] and each["remedy"] for each in answer["reasons"])
    assert all(len(each["pose"]["covariance"]) == 36 for each in answer["hypotheses"])
    LocalizeAnswer.model_validate(answer)


def numbered(parts: dict[str, bytes], count: int, document: dict[str, Any]) -> dict[str, bytes]:
    pictures = {f"{name}{k}": parts[name] for k in range(count) for name in ("rgb", "depth")}
    return pictures | {"request": json.dumps(document).encode()}


def test_rest(refusing: Any, parts_of: Parts) -> None:
    """The covariance spans the map, since the only hypothesis is as likely wrong as right: 100 m between two streets."""
    parts = parts_of(T_vehicle_camera=VEHICLE)
    answer = posted(refusing.client, "/v1/localize", parts).json()
    require_refused(answer, refusing.status)
    narrow = np.sqrt(np.diag(np.array(answer["hypotheses"][0]["pose"]["covariance"]).reshape(6, 6)))[:2]
    wide = np.sqrt(np.diag(np.array(answer["spread"]["covariance"]).reshape(3, 3)))[:2]
    assert narrow.max() < 1.5
    assert wide.max() > 30
    assert answer["spread"]["hypotheses_weight"] <= 1
    request = json.loads(parts["request"])
    batch = posted(refusing.client, "/v1/localize/batch", numbered(parts, 1, {"requests": [request]})).json()
    require_refused(batch["outcomes"][0]["answer"], refusing.status)
    sequence = posted(
        refusing.client,
        "/v1/localize/sequence",
        numbered(parts, 1, {"frames": [{"camera": request["camera"], "depth": request["depth"]}]}),
    )
    require_refused(sequence.json(), refusing.status)
    require_refused(posted(refusing.client, "/v1/explain", parts).json()["answer"], refusing.status)


def test_the_same_question_less_strict_has_its_pose(refusing: Any, parts_of: Parts) -> None:
    parts = parts_of(T_vehicle_camera=VEHICLE, options={"false_accept_rate": LENIENT})
    answer = posted(refusing.client, "/v1/localize", parts).json()
    assert answer["status"] == "LOCALIZED"
    assert all(answer[name] is not None for name in NONE)
    assert (answer["spread"], answer["reasons"]) == (None, [])
    assert [each["confirmed"] for each in answer["hypotheses"]] == [True] + [False] * (len(answer["hypotheses"]) - 1)
    assert answer["hypotheses"][0]["pose"] == answer["pose"]


def test_grpc(refusing: Any, parts_of: Parts) -> None:
    parts, AHEAD = parts_of(), pb.RigidTransform(**VEHICLE)
    request = pb.LocalizeRequest(
        rgb=parts["rgb"],
        depth=parts["depth"],
        camera=CAMERA,
        depth_format=pb.DepthFormat(scale_m=1),
        vehicle_from_camera=AHEAD,
    )
    frame = pb.SequenceFrame(rgb=request.rgb, depth=request.depth, camera=CAMERA, depth_format=request.depth_format)
    stub: LocalizationServiceStub = refusing.stub
    answers = [
        stub.Localize(request),
        stub.LocalizeBatch(pb.LocalizeBatchRequest(requests=[request])).outcomes[0].answer,
        stub.LocalizeSequence(pb.LocalizeSequenceRequest(frames=[frame], vehicle_from_camera=AHEAD)).answer,
        next(stub.LocalizeStream(iter([pb.LocalizeStreamRequest(frame=request)]))).outcome.answer,
    ]
    for answer in answers:
        assert pb.LocalizationStatus.Name(answer.status) == f"LOCALIZATION_STATUS_{refusing.status}"
        assert [name for name in NONE if answer.HasField(name)] == []
        assert answer.HasField("spread")
        assert answer.hypotheses
        assert not any(each.confirmed for each in answer.hypotheses)


def test_both_faces_and_clients_give_the_same_reasons(refusing: Any, parts_of: Parts, pictures: Any) -> None:
    """All evidence more than 3 standard deviations from 0 is told with its size, and no number is infinite or not one."""
    parts = parts_of()
    response = posted(refusing.client, "/v1/localize", parts)
    json.loads(response.text, parse_constant=pytest.fail)
    reasons = response.json()["reasons"]
    message = refusing.stub.Localize(
        pb.LocalizeRequest(
            rgb=parts["rgb"], depth=parts["depth"], camera=CAMERA, depth_format=pb.DepthFormat(scale_m=1)
        )
    )
    assert [(each.check, dict(each.evidence), each.remedy) for each in message.reasons] == [
        (each["check"], each["evidence"], each["remedy"]) for each in reasons
    ]
    sizes = [size for each in reasons for size in each["evidence"].values()]
    assert min(map(abs, sizes)) > 3
    rgb, depth_m, camera = pictures
    with Client(refusing.url) as rest, GrpcClient(refusing.address) as messages:
        told = [
            [each.model_dump() for each in client.localize(rgb, depth_m, camera).reasons] for client in (rest, messages)
        ]
    assert [[each["check"] for each in found] for found in told] == [[each["check"] for each in reasons]] * 2
    assert told[0] == told[1]


def test_geopose_in_both_formats_is_a_problem_and_no_position(refusing: Any, parts_of: Parts) -> None:
    refused = posted(refusing.client, "/v1/localize", parts_of(), Accept="application/geopose+json")
    assert (refused.status_code, refused.json()["code"]) == (404, "no-pose")
    assert refusing.status in refused.json()["detail"]


def test_the_last_answers_tell_no_position(refusing: Any, parts_of: Parts) -> None:
    posted(refusing.client, "/v1/localize", parts_of())
    (newest,) = refusing.client.get("/v1/answers?most=1").json()["answers"]
    assert newest["status"] == refusing.status
    assert (newest["position"], newest["heading_deg"], newest["street"]) == (None, None, None)


def test_the_clients_have_no_pose_to_give(refusing: Any, pictures: Any) -> None:
    rgb, depth_m, camera = pictures
    with Client(refusing.url) as rest, GrpcClient(refusing.address) as messages:
        for client in (rest, messages):
            answer = client.localize(rgb, depth_m, camera)
            assert (answer.status, answer.pose) == (refusing.status, None)
            with pytest.raises(NotLocalizedError):
                answer.require_pose()
            sure = client.localize(rgb, depth_m, camera, options=Options(false_accept_rate=LENIENT))
            assert sure.require_pose() == sure.pose
