"""The two external formats over HTTP, on a georeferenced map: OGC GeoPose by negotiation, OSCP by its own route."""

import base64
import json
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from service.contract.convert import geopose_of
from service.geometry.rigid import R_BODY_OPTICAL, rotation_z, transform_from
from service.maps.calibration import Calibration
from service.maps.content import BundleContent
from service.maps.reader import MapBundle
from service.maps.writer import write_bundle
from service.runtime.engine import Engine
from service.runtime.settings import Settings

Parts = Callable[..., dict[str, bytes]]
ClientOf = Callable[[Engine], httpx.Client]
ACCEPT = {"Accept": "application/vnd.oscp+json;version=2.0;"}
#: Requests as the Python, C++ and JavaScript clients of the protocol write them; pictures are put in by the test.
GOLDEN = Path(__file__).parents[2] / "golden" / "oscp"
MUNICH = {"latitude_deg": 48.0, "longitude_deg": 11.0, "height_m": 500.0}


@pytest.fixture(scope="module")
def on_earth(content: BundleContent, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("maps") / "munich"
    write_bundle(path, replace(content, georeference=MUNICH))
    return path


@pytest.fixture(scope="module")
def client(on_earth: Path, client_of: ClientOf) -> Iterator[httpx.Client]:
    engine = Engine.open(Settings(maps=(on_earth,), threads=1))
    yield client_of(engine)
    engine.close()


@pytest.mark.parametrize(
    ("heading_deg", "camera", "vehicle"),
    [
        # Looking east: the camera's x is south, y down, z east. The vehicle's axes are east, north, up.
        (0.0, (-0.5, 0.5, -0.5, 0.5), (0, 0, 0, 1)),
        # Looking north: the camera's x is east, z north. The vehicle is turned left by 90 degrees.
        (90.0, (-math.sqrt(0.5), 0, 0, math.sqrt(0.5)), (0, 0, math.sqrt(0.5), math.sqrt(0.5))),
    ],
)
def test_quaternions_known_by_hand(on_earth: Path, heading_deg: float, camera: Any, vehicle: Any) -> None:
    """At the map origin, east, north and up are the map axes. The answer has only members of the standard."""
    bundle = MapBundle.open(on_earth)
    body = rotation_z(math.radians(heading_deg))
    for R, expected in ((body @ R_BODY_OPTICAL, camera), (body, vehicle)):
        found = geopose_of(transform_from(R, np.zeros(3)), bundle)
        assert found is not None
        told = found.model_dump()
        assert set(told) == {"position", "quaternion"}
        assert told["position"] == pytest.approx({"lat": 48.0, "lon": 11.0, "h": 500.0}, abs=1e-9)
        q = np.array(list(told["quaternion"].values()))
        assert list(told["quaternion"]) == ["x", "y", "z", "w"]
        np.testing.assert_allclose(q * np.sign(q @ np.array(expected)), expected, atol=1e-9)


def test_far_from_the_origin_up_is_another(on_earth: Path) -> None:
    """100 km east of the origin, the ellipsoid normal leans east by 0.90 degrees. The map axes lean back by the same angle."""
    bundle = MapBundle.open(on_earth)
    found = geopose_of(transform_from(np.eye(3), np.array([100_000.0, 0, 0])), bundle)
    assert found is not None
    assert found.position.h == pytest.approx(500 + 100_000**2 / (2 * 6.388e6), abs=1)
    assert math.degrees(2 * math.acos(found.quaternion.w)) == pytest.approx(
        1.34, abs=0.03
    )  # 0.90 lean, and north turns by 0.99


def post(client: httpx.Client, parts: dict[str, bytes], **headers: str) -> Any:
    return client.post("/v1/localize", files={name: (name, data) for name, data in parts.items()}, headers=headers)


def test_the_answer_carries_a_geopose_and_negotiation_gives_it_alone(client: httpx.Client, parts_of: Parts) -> None:
    whole = post(client, parts_of())
    assert whole.headers["vary"] == "Accept"
    geopose = whole.json()["geopose"]
    assert geopose["position"]["lat"] == pytest.approx(48 + 2 / 111_200, abs=0.5 / 111_200 + 1e-2)
    alone = post(client, parts_of(), Accept="application/geopose+json")
    assert alone.headers["content-type"] == "application/geopose+json"
    assert alone.json() == geopose
    assert set(alone.json()) == {"position", "quaternion"}


def test_with_a_vehicle_the_geopose_is_the_vehicles(client: httpx.Client, parts_of: Parts) -> None:
    T = {"position": {"x": 0, "y": 0, "z": 0}, "orientation": {"x": -0.5, "y": 0.5, "z": -0.5, "w": 0.5}}
    geopose = post(client, parts_of(T_vehicle_camera=T)).json()["geopose"]
    q = geopose["quaternion"]
    heading = math.degrees(math.atan2(2 * (q["w"] * q["z"] + q["x"] * q["y"]), 1 - 2 * (q["y"] ** 2 + q["z"] ** 2)))
    assert heading == pytest.approx(90, abs=1.5)


def oscp(parts: dict[str, bytes], **changed: Any) -> dict[str, Any]:
    """Return a request like that of the reference clients: float times, and null for unknown values."""

    def camera(kind: str, content: bytes) -> dict[str, Any]:
        params = {
            "model": "PINHOLE",
            "modelParams": [32.0, 32.0, 32.0, 24.0],
            "minMaxDepth": None,
            "minMaxDisparity": None,
        }
        return {
            "timestamp": 1.7e12,
            "sensorId": "0",
            "privacy": None,
            "sequenceNumber": 0,
            "imageFormat": kind,
            "size": [64, 48],
            "imageBytes": base64.b64encode(content).decode(),
            "imageOrientation": {"mirrored": False, "rotation": 0},
            "params": params,
        }

    readings = {
        "cameraReadings": [camera("RGBA32", parts["rgb"]), camera("DEPTH", parts["depth"])],
        "geolocationReadings": None,
    }
    sensors = [{"id": "0", "type": "camera", "name": None, "model": None, "rigIdentifier": None}]
    return {
        "id": "mine",
        "timestamp": 1.7e12 + 0.5,
        "type": "geopose",
        "sensors": sensors,
        "sensorReadings": readings,
        "priorPoses": [],
    } | changed


def test_a_reference_client_gets_the_same_pose(client: httpx.Client, parts_of: Parts) -> None:
    parts = parts_of()
    rest = post(client, parts).json()
    answer = client.post("/geopose", json=oscp(parts), headers=ACCEPT)
    assert answer.status_code == 200, answer.text
    told = answer.json()
    assert list(told) == ["id", "timestamp", "type", "accuracy", "geopose"]
    assert (told["id"], told["type"], type(told["timestamp"])) == ("mine", "geopose", int)
    assert told["geopose"] == rest["geopose"]
    sigma = np.sqrt(np.diag(np.array(rest["pose"]["covariance"]).reshape(6, 6)))
    assert told["accuracy"] == pytest.approx(
        {"position": sigma[:3].mean(), "orientation": np.rad2deg(sigma[3:]).mean()}
    )


@pytest.mark.parametrize("name", ["python", "cpp", "javascript"])
def test_the_reference_clients_requests_are_answered_unchanged(
    client: httpx.Client, parts_of: Parts, name: str
) -> None:
    """Each reference client's request as it writes it, with headers and a DEPTH reading beside the image."""
    sent = json.loads((GOLDEN / f"{name}.json").read_text())
    parts = parts_of()
    for reading in sent["body"]["sensorReadings"]["cameraReadings"]:
        assert reading["imageBytes"] == ""
        content = parts["depth"] if reading["imageFormat"] == "DEPTH" else parts["rgb"]
        reading["imageBytes"] = base64.b64encode(content).decode()
    answer = client.post("/geopose", content=json.dumps(sent["body"]), headers=sent["headers"])
    assert answer.status_code == 200, answer.text
    told = answer.json()
    assert told["id"] == sent["body"]["id"]
    expected = post(client, parts).json()["geopose"]["position"]
    assert told["geopose"]["position"]["lat"] == pytest.approx(expected["lat"], abs=1e-6)


def test_a_query_without_depth_is_refused_with_the_missing_part(client: httpx.Client, parts_of: Parts) -> None:
    request = oscp(parts_of())
    del request["sensorReadings"]["cameraReadings"][1]
    refused = client.post("/geopose", json=request, headers=ACCEPT)
    assert (refused.status_code, refused.json()["code"]) == (422, "request")
    assert "DEPTH" in refused.json()["detail"]


@pytest.mark.parametrize(
    "accept",
    ["application/vnd.oscp+json", "application/vnd.oscp+json;version=1.0", "application/vnd.oscp+json;version=x, */*"],
)
def test_another_version_is_refused(client: httpx.Client, parts_of: Parts, accept: str) -> None:
    refused = client.post("/geopose", json=oscp(parts_of()), headers={"Accept": accept})
    assert (refused.status_code, refused.json()["code"]) == (400, "bad-request")
    assert "version=2.0" in refused.json()["detail"]


@pytest.mark.parametrize("body", [b"", b"[]", b"{", b'{"sensorReadings": 3}', b"[" * 100_000])
def test_an_invalid_request_is_refused(client: httpx.Client, body: bytes) -> None:
    refused = client.post("/geopose", content=body, headers=ACCEPT)
    assert (refused.status_code, refused.json()["code"]) == (422, "request")


def test_the_protocol_identifies_itself(client: httpx.Client) -> None:
    assert client.get("/geopose").json()["version"] == "2.0"


def test_a_map_without_georeference_is_reported(bundle_path: Path, parts_of: Parts, client_of: ClientOf) -> None:
    engine = Engine.open(Settings(maps=(bundle_path,), threads=1))
    client = client_of(engine)
    for refused in (
        post(client, parts_of(), Accept="application/geopose+json"),
        client.post("/geopose", json=oscp(parts_of()), headers=ACCEPT),
    ):
        assert (refused.status_code, refused.json()["code"]) == (422, "no-georeference")
    assert post(client, parts_of()).json()["geopose"] is None
    engine.close()


def test_an_uncertain_answer_is_a_problem_in_a_format_without_uncertainty(
    client: httpx.Client, parts_of: Parts, calibration_of: Callable[..., Calibration], monkeypatch: pytest.MonkeyPatch
) -> None:
    from service.confidence import decision
    from service.confidence.decision import Decision

    monkeypatch.setattr(decision, "decide", lambda *_, **__: Decision("AMBIGUOUS", 0.4, 0.4))
    monkeypatch.setattr(MapBundle, "calibration", calibration_of(), raising=False)
    refused = post(client, parts_of(), Accept="application/geopose+json")
    assert (refused.status_code, refused.json()["code"]) == (404, "no-pose")
    assert "AMBIGUOUS" in refused.json()["detail"]
    assert json.loads(post(client, parts_of()).content)["status"] == "AMBIGUOUS"
    refused = client.post("/geopose", json=oscp(parts_of()), headers=ACCEPT)
    assert (refused.status_code, refused.json()["code"]) == (404, "no-pose")
