"""With several maps and no name, the nearest map to the prior on the Earth answers, through every face."""

import base64
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import grpc
import httpx
import pytest

from service.grpc.generated.streetfix.v1 import localization_pb2 as pb
from service.maps.content import BundleContent
from service.maps.writer import write_bundle

Parts = Callable[..., dict[str, bytes]]
CAMERA: dict[str, Any] = {"width": 64, "height": 48, "fx": 32, "fy": 32, "cx": 31.5, "cy": 23.5}
DEPTH: dict[str, Any] = {"scale_m": 1}
#: Requests as the clients of the OSCP protocol write them.
GOLDEN = Path(__file__).parents[1] / "golden" / "oscp"
#: Origins of the maps, degrees.
ORIGINS = {"north": (50.1, 8.0), "south": (50.0, 8.0)}
#: It neither moved nor turned.
STILL = {"position": {"x": 0.0, "y": 0.0, "z": 0.0}, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}


def prior_at(name: str) -> dict[str, Any]:
    latitude_deg, longitude_deg = ORIGINS[name]
    return {"wgs84": {"latitude_deg": latitude_deg, "longitude_deg": longitude_deg, "std_m": 50}}


@pytest.fixture(scope="module")
def faces(
    content_of: Callable[..., BundleContent], tmp_path_factory: pytest.TempPathFactory, serving: Any
) -> Iterator[Any]:
    folder: Path = tmp_path_factory.mktemp("maps")
    for name, (latitude_deg, longitude_deg) in ORIGINS.items():
        georeference = {"latitude_deg": latitude_deg, "longitude_deg": longitude_deg}
        write_bundle(folder / name, content_of(name=name, georeference=georeference))
    with serving(folder) as found:
        yield found


def posted(client: httpx.Client, path: str, parts: dict[str, bytes]) -> httpx.Response:
    return client.post(path, files={name: (name, data) for name, data in parts.items()})


def numbered(parts: dict[str, bytes], document: dict[str, Any]) -> dict[str, bytes]:
    pictures = {f"{name}{k}": parts[name] for k in range(2) for name in ("rgb", "depth")}
    return pictures | {"request": json.dumps(document).encode()}


def message(parts: dict[str, bytes], **more: Any) -> pb.LocalizeRequest:
    about: dict[str, Any] = {"camera": pb.Camera(**CAMERA), "depth_format": pb.DepthFormat(**DEPTH)} | more
    return pb.LocalizeRequest(rgb=parts["rgb"], depth=parts["depth"], **about)


@pytest.mark.parametrize("name", list(ORIGINS))
def test_one_pair(faces: Any, parts_of: Parts, name: str) -> None:
    client, stub, _ = faces
    rest = posted(client, "/v1/localize", parts_of(prior=prior_at(name)))
    assert rest.status_code == 200, rest.text
    assert rest.json()["map"]["name"] == name
    assert stub.Localize(message(parts_of(), prior=prior_at(name))).map.name == name


@pytest.mark.parametrize("name", list(ORIGINS))
def test_a_sequence(faces: Any, parts_of: Parts, name: str) -> None:
    frames = [{"camera": CAMERA, "depth": DEPTH}, {"camera": CAMERA, "depth": DEPTH, "T_reference_camera": STILL}]
    parts = numbered(parts_of(), {"frames": frames, "prior": prior_at(name)})
    found = posted(faces[0], "/v1/localize/sequence", parts)
    assert found.status_code == 200, found.text
    assert found.json()["map"]["name"] == name


def test_each_query_of_a_batch_has_its_own_map(faces: Any, parts_of: Parts) -> None:
    requests = [{"camera": CAMERA, "depth": DEPTH, "prior": prior_at(name)} for name in ORIGINS]
    found = posted(faces[0], "/v1/localize/batch", numbered(parts_of(), {"requests": requests}))
    assert found.status_code == 200, found.text
    assert [each["answer"]["map"]["name"] for each in found.json()["outcomes"]] == list(ORIGINS)


@pytest.mark.parametrize("name", list(ORIGINS))
def test_the_first_frame_of_a_stream_chooses_the_map_of_all_frames(faces: Any, parts_of: Parts, name: str) -> None:
    (other,) = set(ORIGINS) - {name}
    frames = [
        message(parts_of(), prior=prior_at(name)),
        message(parts_of()),
        message(parts_of(), prior=prior_at(other)),
    ]
    answers = list(faces[1].LocalizeStream(iter([pb.LocalizeStreamRequest(frame=each) for each in frames])))
    assert [each.outcome.answer.map.name for each in answers] == [name] * 3


def test_the_oscp_protocol_names_no_map(faces: Any, parts_of: Parts) -> None:
    """Its reading of a satellite receiver chooses the map. An answer that is not LOCALIZED is the problem `no-pose`, without a map."""
    sent = json.loads((GOLDEN / "python.json").read_text())
    body, parts = sent["body"], parts_of()
    for reading in body["sensorReadings"]["cameraReadings"]:
        content = parts["depth"] if reading["imageFormat"] == "DEPTH" else parts["rgb"]
        reading["imageBytes"] = base64.b64encode(content).decode()
    body["priorPoses"] = []
    for name, (latitude_deg, longitude_deg) in ORIGINS.items():
        body["sensorReadings"]["geolocationReadings"] = [
            {"latitude": latitude_deg, "longitude": longitude_deg, "accuracy": 50.0}
        ]
        found = faces[0].post("/geopose", content=json.dumps(body), headers=sent["headers"])
        assert found.status_code == 200, (name, found.text)
        assert found.json()["geopose"]["position"]["lat"] == pytest.approx(latitude_deg, abs=0.001)
    body["sensorReadings"]["geolocationReadings"] = None
    refused = faces[0].post("/geopose", content=json.dumps(body), headers=sent["headers"])
    assert (refused.status_code, refused.json()["field"]) == (404, "map")


def test_without_a_position_on_the_earth_a_name_is_needed(faces: Any, parts_of: Parts) -> None:
    client, stub, _ = faces
    for about in ({}, {"prior": {"position": {"x": 20.0, "y": 2.0}}}, {"prior": {"heading_deg": 90.0}}):
        refused = posted(client, "/v1/localize", parts_of(**about))
        assert (refused.status_code, refused.json()["field"]) == (404, "map")
        assert "several maps are mounted, and the request names none" in refused.json()["detail"]
        with pytest.raises(grpc.RpcError) as error:
            stub.Localize(message(parts_of(), **about))
        assert error.value.code() == grpc.StatusCode.NOT_FOUND
