import io
import json
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from service.http.geopose import GEOPOSE
from service.http.routes.localize import wants_geopose
from service.maps.content import BundleContent
from service.maps.writer import write_bundle
from service.runtime.engine import Engine
from service.runtime.settings import Limits, Settings

Parts = Callable[..., dict[str, bytes]]


def post(client: httpx.Client, parts: dict[str, bytes], **headers: str) -> httpx.Response:
    files = {name: (name, data) for name, data in parts.items()}
    return client.post("/v1/localize", files=files, headers=headers)


def require_problem(response: httpx.Response, status: int, code: str, field: str | None) -> dict[str, Any]:
    problem: dict[str, Any] = response.json()
    assert (response.status_code, problem["code"], problem["field"]) == (status, code, field), problem
    assert response.headers["content-type"] == "application/problem+json"
    assert problem["type"] == f"/problems/{code}"
    assert problem["status"] == status
    assert problem["request_id"] == response.headers["x-request-id"]
    return problem


def test_the_answer_has_the_contracts_form(client: httpx.Client, parts_of: Parts) -> None:
    response = post(client, parts_of())
    answer = response.json()
    assert response.status_code == 200
    assert list(answer) == [
        "status",
        "confidence",
        "street",
        "pose",
        "vehicle_pose",
        "geopose",
        "hypotheses",
        "spread",
        "reasons",
        "neighbours",
        "camera_height",
        "calibration",
        "extrapolated",
        "threshold",
        "rig_correction",
        "belief",
        "map",
        "timings_ms",
    ]
    assert (answer["status"], answer["confidence"], answer["geopose"]) == ("LOCALIZED", None, None)
    assert answer["street"] | {"vote": 1} == {
        "id": "s2",
        "name": "End of street 2",
        "street": "2",
        "section": "end",
        "class_index": 2,
        "vote": 1,
    }
    assert answer["pose"]["position"]["x"] == pytest.approx(20, abs=0.3)
    assert answer["pose"]["heading_deg"] == pytest.approx(90, abs=1)
    assert len(answer["pose"]["covariance"]) == 36
    assert answer["map"]["name"] == "tiny"
    assert list(answer["timings_ms"]) == ["decode", "fuse", "encode", "search", "register", "total"]
    assert answer["neighbours"][0]["street"] == "s2"
    assert len(answer["neighbours"]) == 5
    best = answer["hypotheses"][0]
    assert list(best) == ["confirmed", "pose", "share", "inliers", "similarity"]
    assert best["confirmed"]
    assert best["pose"] == answer["pose"]
    assert best["inliers"] > 0.8


def test_a_map_without_streets_answers_with_null(
    content_of: Callable[..., BundleContent],
    client_of: Callable[[Engine], httpx.Client],
    parts_of: Parts,
    tmp_path: Path,
) -> None:
    write_bundle(tmp_path / "m", content_of(streets=None, place_street=np.full(12, -1, np.int32)))
    engine = Engine.open(Settings(maps=(tmp_path / "m",), threads=1))
    try:
        answer = post(client_of(engine), parts_of()).json()
    finally:
        engine.close()
    assert answer["street"] is None
    assert {neighbour["street"] for neighbour in answer["neighbours"]} == {None}
    assert answer["pose"]["position"]["x"] == pytest.approx(20, abs=0.3)


def test_without_registration_there_is_no_covariance(client: httpx.Client, parts_of: Parts) -> None:
    answer = post(client, parts_of(options={"refine": False})).json()
    assert answer["pose"]["covariance"] is None
    assert answer["hypotheses"] == []
    assert answer["timings_ms"]["register"] == 0
    assert answer["pose"]["position"]["x"] == pytest.approx(20, abs=0.05)


def test_as_many_neighbours_as_asked_for(client: httpx.Client, parts_of: Parts) -> None:
    answer = post(client, parts_of(options={"neighbours": 2, "refine": False})).json()
    assert len(answer["neighbours"]) == 2


def test_the_vehicle_pose_is_returned_on_request(client: httpx.Client, parts_of: Parts) -> None:
    # The camera looks forward, 1 m before and 0.5 m above the vehicle's origin.
    T = {"position": {"x": 1, "y": 0, "z": 0.5}, "orientation": {"x": -0.5, "y": 0.5, "z": -0.5, "w": 0.5}}
    answer = post(client, parts_of(T_vehicle_camera=T)).json()
    camera, vehicle = answer["pose"], answer["vehicle_pose"]
    assert vehicle["heading_deg"] == pytest.approx(camera["heading_deg"], abs=1e-6)
    assert vehicle["position"]["y"] == pytest.approx(camera["position"]["y"] - 1, abs=0.05)
    assert vehicle["position"]["z"] == pytest.approx(camera["position"]["z"] - 0.5, abs=0.05)
    known = [np.array(pose["covariance"]).reshape(6, 6) for pose in (camera, vehicle)]
    np.testing.assert_allclose(known[1][3:, 3:], known[0][3:, 3:])
    # Heading is along y here, so a metre behind the camera: what is not known of the heading is a metre's swing along x.
    swing = known[0][0, 0] + 2 * known[0][0, 5] + known[0][5, 5]
    assert known[1][0, 0] == pytest.approx(swing, rel=0.2)
    assert known[1][0, 0] != known[0][0, 0]


@pytest.mark.parametrize("part", ["rgb", "depth", "request"])
def test_a_missing_part_is_named(client: httpx.Client, parts_of: Parts, part: str) -> None:
    parts = parts_of()
    del parts[part]
    require_problem(post(client, parts), 422, "request", part)


def test_an_unknown_part_is_named(client: httpx.Client, parts_of: Parts) -> None:
    require_problem(post(client, parts_of() | {"lidar": b"1"}), 422, "request", "lidar")


@pytest.mark.parametrize("part", ["rgb", "depth"])
def test_a_damaged_picture_is_named(client: httpx.Client, parts_of: Parts, part: str) -> None:
    parts = parts_of()
    parts[part] = parts[part][: len(parts[part]) // 2]
    require_problem(post(client, parts), 422, "undecodable", part)


@pytest.mark.parametrize("part", ["rgb", "depth"])
def test_a_picture_in_no_known_format_is_named(client: httpx.Client, parts_of: Parts, part: str) -> None:
    require_problem(post(client, parts_of() | {part: b"GIF89a" + bytes(50)}), 415, "format", part)


def test_pictures_that_do_not_fit_the_intrinsics_are_named(client: httpx.Client, parts_of: Parts) -> None:
    camera = {"width": 64, "height": 36, "fx": 32, "fy": 32, "cx": 31.5, "cy": 17.5}
    problem = require_problem(post(client, parts_of(camera=camera)), 422, "image-size", "rgb")
    assert "64x48" in problem["detail"]
    assert "64x36" in problem["detail"]


def test_a_picture_of_too_many_pixels_is_refused(client: httpx.Client, parts_of: Parts) -> None:
    import cv2
    import numpy as np

    large = cv2.imencode(".png", np.zeros((200, 200, 3), np.uint8))[1].tobytes()
    require_problem(post(client, parts_of() | {"rgb": large}), 413, "too-large", "rgb")


def test_a_picture_of_too_many_bytes_is_refused(client: httpx.Client, parts_of: Parts) -> None:
    large = parts_of()["rgb"] + bytes(150_000)
    require_problem(post(client, parts_of() | {"rgb": large}), 413, "too-large", "rgb")


def test_too_many_parts_are_refused(client: httpx.Client, parts_of: Parts) -> None:
    require_problem(post(client, parts_of() | {f"part{k}": b"" for k in range(31)}), 413, "too-large", None)


def test_an_announced_body_beyond_the_limit_is_refused_unread(client: httpx.Client) -> None:
    response = client.post("/v1/localize", content=bytes(200_001), headers={"content-type": "multipart/form-data"})
    assert "200001 bytes" in require_problem(response, 413, "too-large", None)["detail"]


def test_a_body_of_unknown_length_is_counted(client: httpx.Client) -> None:
    def chunks() -> Iterator[bytes]:
        for _ in range(300):
            yield bytes(1000)

    response = client.post("/v1/localize", content=chunks(), headers={"content-type": "multipart/form-data"})
    require_problem(response, 413, "too-large", None)


def test_another_content_type_is_refused(client: httpx.Client) -> None:
    require_problem(client.post("/v1/localize", json={}), 415, "format", None)


def test_an_unknown_map_is_refused_with_the_mounted_ones(client: httpx.Client, parts_of: Parts) -> None:
    problem = require_problem(post(client, parts_of(map="west")), 404, "unknown-map", "map")
    assert "mounted maps: tiny" in problem["detail"]


@pytest.mark.parametrize("name", sorted(set(Limits.model_fields) - {"max_message_bytes"}))
def test_every_limit_of_the_settings_refuses_what_is_beyond_it(
    bundle_path: Path, client_of: Callable[[Engine], httpx.Client], parts_of: Parts, name: str
) -> None:
    """The same valid request exceeds the smallest value of each limit: body, images and pixels.

    The tests of gRPC cover the limit of a gRPC message.
    """
    least = {"max_request_bytes": 1024, "max_part_bytes": 1024, "max_pixels": 1}[name]
    engine = Engine.open(Settings(maps=(bundle_path,), threads=1, limits=Limits(**{name: least})))
    response = post(client_of(engine), parts_of())
    engine.close()
    assert (response.status_code, response.json()["code"]) == (413, "too-large")


def test_no_depth_is_a_problem_of_its_own(client: httpx.Client, parts_of: Parts) -> None:
    require_problem(post(client, parts_of(depth={"scale_m": 0.001, "max_range_m": 0.01})), 422, "no-depth", "depth")


@pytest.mark.parametrize(
    ("factor", "told"),
    [
        (1000.0, "which looks like millimetres; send depth.scale_m = 0.001"),
        (0.001, "which looks like metres that were read as millimetres; send depth.scale_m = 1"),
    ],
)
def test_a_depth_in_another_unit_is_reported_with_its_scale(
    client: httpx.Client, parts_of: Parts, pictures: Any, factor: float, told: str
) -> None:
    np.save(file := io.BytesIO(), pictures[1] * np.float32(factor))
    for depth in ({"scale_m": 1}, {}):
        sent = parts_of(depth=depth) | {"depth": file.getvalue()}
        assert told in require_problem(post(client, sent), 422, "no-depth", "depth")["detail"]


ORIGIN = {"x": 0, "y": 0, "z": 0}
CAMERA = {"width": 64, "height": 48, "fx": 32, "fy": 32, "cx": 31.5, "cy": 23.5}


@pytest.mark.parametrize(
    ("changed", "field"),
    [
        ({"camera": None}, "camera"),
        ({"camera": CAMERA | {"fx": 0}}, "camera.fx"),
        ({"camera": CAMERA | {"fx": "wide"}}, "camera.fx"),
        ({"camera": CAMERA | {"model": "FISHEYE"}}, "camera.model"),
        ({"camera": CAMERA | {"skew": 1}}, "camera.skew"),
        ({"depth": {"kind": "inverse"}}, "depth.kind"),
        ({"depth": {"scale": 1}}, "depth.scale"),
        ({"gravity": {"x": 0, "y": 0, "z": 0}}, "gravity"),
        ({"gravity": {"x": 0, "y": 1}}, "gravity.z"),
        ({"options": {"neighbours": 51}}, "options.neighbours"),
        ({"options": {"false_accept_rate": 0}}, "options.false_accept_rate"),
        ({"options": {"false_accept_rate": 1}}, "options.false_accept_rate"),
        ({"prior": {"position": {"x": 0, "y": 0, "z": 0}}}, "prior.position.z"),
        ({"prior": {"position": {"x": 0}}}, "prior.position.y"),
        ({"prior": {"position": {"x": 0, "y": 0, "std_m": 0}}}, "prior.position.std_m"),
        ({"prior": {"wgs84": {"latitude_deg": 91, "longitude_deg": 0}}}, "prior.wgs84.latitude_deg"),
        ({"prior": {"wgs84": {"latitude_deg": 0, "longitude_deg": -181}}}, "prior.wgs84.longitude_deg"),
        ({"prior": {"wgs84": {"latitude_deg": 0, "longitude_deg": 0, "height_m": 0}}}, "prior.wgs84.height_m"),
        ({"prior": {"heading_deg": 361}}, "prior.heading_deg"),
        ({"prior": {"heading_deg": 0, "heading_std_deg": 0}}, "prior.heading_std_deg"),
        ({"prior": {"place": 8}}, "prior.place"),
        ({"prior": {}}, "prior"),
        ({"prior": {"heading_std_deg": 5}}, "prior"),
        ({"prior": {"position": {"x": 0, "y": 0}, "wgs84": {"latitude_deg": 0, "longitude_deg": 0}}}, "prior"),
        ({"prior": {"wgs84": {"latitude_deg": 0, "longitude_deg": 0}}}, "prior.wgs84"),
        ({"surprise": 1}, "surprise"),
        ({"T_vehicle_camera": {"position": ORIGIN, "orientation": ORIGIN | {"w": 0}}}, "T_vehicle_camera.orientation"),
    ],
)
def test_a_bad_field_is_named(client: httpx.Client, parts_of: Parts, changed: dict[str, Any], field: str) -> None:
    require_problem(post(client, parts_of(**changed)), 422, "request", field)


@pytest.mark.parametrize("text", [b"", b"{", b"[]", b"\xff", b"[" * 100_000, b'{"camera": NaN}'])
def test_a_request_that_is_no_json_object_is_refused(client: httpx.Client, parts_of: Parts, text: bytes) -> None:
    response = post(client, parts_of() | {"request": text})
    assert (response.status_code, response.json()["code"]) == (422, "request")


@pytest.mark.parametrize(
    ("changed", "field", "text"),
    [
        ({"distortion": [0.1, 0]}, "camera.distortion", "does not have 2 coefficients"),
        ({"distortion": [0, 0, 0, 0], "distortion_model": "omni"}, "camera.distortion_model", "'kannala_brandt'"),
        ({"distortion": [0, 0, -2, 0]}, "camera.distortion", "p1 = -2 is no lens"),
        ({"distortion": [-0.3, 0, 0, 0]}, "camera.distortion", "stops growing"),
        ({"cx": -100, "distortion": [0] * 4, "distortion_model": "kannala_brandt"}, "camera", "would be empty"),
    ],
)
def test_a_lens_that_cannot_be_rectified_is_refused_with_the_field(
    client: httpx.Client, parts_of: Parts, changed: dict[str, Any], field: str, text: str
) -> None:
    problem = require_problem(post(client, parts_of(camera=CAMERA | changed)), 422, "request", field)
    assert text in problem["detail"]


def test_a_disparity_of_distorted_images_is_refused(client: httpx.Client, parts_of: Parts) -> None:
    camera = CAMERA | {"distortion": [-0.1, 0.02, 0, 0]}
    depth = {"kind": "disparity", "scale_m": 1, "baseline_m": 0.1}
    require_problem(post(client, parts_of(camera=camera, depth=depth)), 422, "request", "depth.kind")


TRUE_PRIOR = {"position": {"x": 20, "y": 100, "std_m": 5}, "heading_deg": 90}


@pytest.mark.parametrize(
    "prior",
    [
        TRUE_PRIOR,
        {"heading_deg": -270},
        {"position": {"x": 5000, "y": -5000, "std_m": 0.1}, "heading_deg": 270, "heading_std_deg": 1},
    ],
)
def test_a_prior_right_or_wrong_does_not_move_an_answer_that_the_pictures_are_sure_of(
    client: httpx.Client, parts_of: Parts, prior: dict[str, Any]
) -> None:
    alone, with_prior = (post(client, parts_of(**changed)).json() for changed in ({}, {"prior": prior}))
    assert with_prior["pose"] == alone["pose"]


def test_gravity_of_any_length_is_taken(client: httpx.Client, parts_of: Parts) -> None:
    answer = post(client, parts_of(gravity={"x": 0, "y": 9.81, "z": 0}))
    assert answer.status_code == 200


def test_a_request_id_of_the_callers_is_kept(client: httpx.Client, parts_of: Parts) -> None:
    response = post(client, parts_of(), **{"X-Request-Id": "robot-7.42"})
    assert response.headers["x-request-id"] == "robot-7.42"


def test_a_request_id_that_could_forge_a_log_is_replaced(client: httpx.Client, parts_of: Parts) -> None:
    response = post(client, parts_of(), **{"X-Request-Id": "a b"})
    assert len(response.headers["x-request-id"]) == 32


def test_an_unexpected_error_shows_the_request_id_only(
    client: httpx.Client,
    engine: Engine,
    parts_of: Parts,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    def fail(_: object) -> None:
        raise ZeroDivisionError("secret inner state")

    monkeypatch.setattr(engine, "localize", fail)
    response = post(client, parts_of())
    problem = require_problem(response, 500, "internal", None)
    assert "secret" not in json.dumps(problem)
    assert "secret inner state" in caplog.text
    assert problem["request_id"] in caplog.text


def test_beyond_the_queue_the_answer_is_busy_with_retry_after(
    client: httpx.Client, engine: Engine, parts_of: Parts
) -> None:
    release, running = threading.Event(), threading.Event()

    def hold() -> None:
        running.set()
        release.wait(30)

    held: list[Future[None]] = [engine.admission.submit(hold)]
    assert running.wait(30)
    held.append(engine.admission.submit(lambda: None))
    try:
        response = post(client, parts_of())
        require_problem(response, 503, "busy", None)
        assert response.headers["retry-after"] == "1"
        assert client.get("/livez").status_code == 200
    finally:
        release.set()
        for future in held:
            future.result(30)


def test_a_request_that_takes_too_long_is_reported(
    engine: Engine, parts_of: Parts, client_of: Callable[[Engine], httpx.Client]
) -> None:
    hurried = Engine(engine.registry, Settings(threads=1, request_timeout_s=0.05))
    release = threading.Event()
    held = hurried.admission.submit(lambda: release.wait(30))
    try:
        require_problem(post(client_of(hurried), parts_of()), 504, "deadline", None)
    finally:
        release.set()
        held.result(30)
        hurried.close()


@pytest.mark.parametrize(
    ("accept", "expected"),
    [
        ("", False),
        ("*/*", False),
        ("application/json", False),
        (GEOPOSE, True),
        (f"{GEOPOSE};version=1.0", True),
        (f"application/json, {GEOPOSE}", False),
        (f"{GEOPOSE}, application/json", True),
        (f"{GEOPOSE};q=0.5, application/json", False),
        (f"application/json;q=0.5, {GEOPOSE};q=0.9", True),
        (f"*/*;q=0.1, {GEOPOSE};q=0.2", True),
        (f"{GEOPOSE};q=0", False),
        (f"{GEOPOSE};q=lots", False),
        ("text/html, application/xml;q=0.9, */*;q=0.8", False),
        (GEOPOSE.upper(), True),
    ],
)
def test_qualities_decide_and_of_equal_ones_the_first(accept: str, expected: bool) -> None:
    assert wants_geopose(accept) == expected


@pytest.mark.parametrize(
    ("changed", "field"),
    [
        ({"vehicle_base_on_ground": True}, "vehicle_base_on_ground"),
        (
            {
                "vehicle_base_on_ground": True,
                "T_vehicle_camera": {
                    "position": {"x": 0, "y": 0, "z": -1},
                    "orientation": {"x": 0, "y": 0, "z": 0, "w": 1},
                },
            },
            "T_vehicle_camera.position.z",
        ),
    ],
)
def test_a_vehicle_on_the_ground_without_a_height_is_a_problem_that_names_the_field(
    client: httpx.Client, parts_of: Parts, changed: dict[str, Any], field: str
) -> None:
    problem = post(client, parts_of(**changed)).json()
    assert (problem["status"], problem["code"], problem["field"]) == (422, "request", field)


def test_a_wrong_value_is_in_the_answer_but_not_in_the_log(
    client: httpx.Client, parts_of: Parts, caplog: pytest.LogCaptureFixture
) -> None:
    parts = parts_of()
    request = json.loads(parts["request"])
    request["camera"]["fx"] = "private words"
    with caplog.at_level("DEBUG"):
        problem = require_problem(
            post(client, parts | {"request": json.dumps(request).encode()}), 422, "request", "camera.fx"
        )
    assert '(given: "private words")' in problem["detail"]
    assert "private words" not in caplog.text
    assert any(record.name == "streetfix.requests" for record in caplog.records)
    assert all("private words" not in str(vars(record)) for record in caplog.records)
