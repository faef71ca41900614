"""Every number of a request has bounds. At, beside and beyond them, the service answers or refuses with a clear error.

The fields come from the OpenAPI document and the proto file, so a new field is tested too.
"""

import io
import json
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import grpc
import httpx
import numpy as np
import pytest
from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import Message
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from service.geometry.distortion import COEFFICIENTS, LIMITS
from service.grpc.generated.streetfix.v1 import localization_pb2 as pb
from service.grpc.reading import SERVICE
from service.grpc.server import GrpcServer
from service.http.openapi import openapi_text
from service.maps.writer import write_bundle
from service.runtime.engine import Engine
from service.runtime.settings import Settings

Parts = Callable[..., dict[str, bytes]]
Json = dict[str, Any]
#: A value at each level of a path; a list's element is 0.
Path_ = tuple[str | int, ...]
AHEAD = {"position": {"x": 0.1, "y": 0.0, "z": 1.0}, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}


@dataclass(frozen=True)
class Number:
    """A number of a request: its path and its schema."""

    path: Path_
    schema: Json

    @property
    def name(self) -> str:
        return ".".join(str(part) for part in self.path)

    def extremes(self) -> list[tuple[float, bool]]:
        """Return values at both bounds and just outside, with whether each is valid."""
        whole = self.schema["type"] == "integer"
        found: list[tuple[float, bool]] = []
        for bound, exclusive, outwards in (
            ("minimum", "exclusiveMinimum", -math.inf),
            ("maximum", "exclusiveMaximum", math.inf),
        ):
            if exclusive in self.schema:
                edge = self.schema[exclusive]
                inside = edge - math.copysign(1, outwards) if whole else math.nextafter(edge, -outwards)
                found += [(inside, True), (edge, False)]
            else:
                edge = self.schema[bound]
                outside = edge + math.copysign(1, outwards) if whole else math.nextafter(edge, outwards)
                found += [(edge, True), (outside, False)] if math.isfinite(outside) else [(edge, True)]
        return [(int(value) if whole else float(value), within) for value, within in found]


DOCUMENT: Json = json.loads(openapi_text())


def resolved(schema: Json) -> list[Json]:
    """Return the alternatives of a schema, with references resolved."""
    if "$ref" in schema:
        node: Any = DOCUMENT
        for key in schema["$ref"].removeprefix("#/").split("/"):
            node = node[key]
        return resolved(node)
    if "anyOf" in schema:
        return [found for each in schema["anyOf"] for found in resolved(each)]
    return [schema]


def numbers_in(schema: Json, path: Path_ = ()) -> Iterator[Number]:
    for each in resolved(schema):
        if each.get("type") in ("number", "integer"):
            yield Number(path, each)
        for name, inner in each.get("properties", {}).items():
            yield from numbers_in(inner, (*path, name))
        if "items" in each:
            yield from numbers_in(each["items"], (*path, 0))


def request_schemas() -> dict[str, Json]:
    """Return the JSON schemas of all request bodies and parameters, by operation."""
    found: dict[str, Json] = {}
    for operations in DOCUMENT["paths"].values():
        for operation in operations.values():
            name = operation["operationId"]
            for parameter in operation.get("parameters", ()):
                found[f"{name}?{parameter['name']}"] = parameter["schema"]
            for content in operation.get("requestBody", {}).get("content", {}).values():
                found[name] = content["schema"]
    return found


def of(name: str) -> list[Number]:
    """Return a component of the document."""
    return list(numbers_in({"$ref": f"#/components/schemas/{name}"}))


def test_every_number_of_every_request_has_a_least_and_a_most() -> None:
    numbers = [(name, number) for name, schema in request_schemas().items() for number in numbers_in(schema)]
    assert len(numbers) > 100
    assert {name for name, _ in numbers} >= {"localize", "localizeSequence", "localizeBatch", "postGeoPose", "explain"}
    unbounded = [
        f"{name} {number.name}"
        for name, number in numbers
        if not (
            {"minimum", "exclusiveMinimum"} & set(number.schema)
            and {"maximum", "exclusiveMaximum"} & set(number.schema)
        )
    ]
    assert unbounded == []


@pytest.fixture(scope="module")
def client(
    content_of: Any,
    calibration_json: Any,
    client_of: Callable[[Engine], httpx.Client],
    tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[httpx.Client]:
    """Return a client of a georeferenced, calibrated map."""
    folder = tmp_path_factory.mktemp("extremes") / "tiny"
    georeference = {"latitude_deg": 52.52, "longitude_deg": 13.405, "height_m": 70.0}
    write_bundle(folder, content_of(georeference=georeference, calibration=calibration_json()))
    engine = Engine.open(Settings(maps=(folder,), threads=1))
    yield client_of(engine)
    engine.close()


def full_request(parts_of: Parts, prior: str = "position") -> Json:
    """Return a request with every optional number. ``prior`` is position or wgs84."""
    document: Json = json.loads(parts_of()["request"])
    where = {
        "position": {"x": 20, "y": 100, "std_m": 5},
        "wgs84": {"latitude_deg": 52.52, "longitude_deg": 13.4, "std_m": 50},
    }
    return document | {
        "depth": {"scale_m": 1, "kind": "z", "max_range_m": 80, "baseline_m": 0.12},
        "gravity": {"x": 0.01, "y": 1, "z": 0.01},
        "T_vehicle_camera": AHEAD,
        "camera": document["camera"] | {"height_m": 1.5, "height_std_m": 0.05},
        "prior": {prior: where[prior], "heading_deg": 90, "heading_std_deg": 20},
        "options": {"neighbours": 5, "refine": True, "false_accept_rate": 0.02},
        "track": {"T_previous_camera": AHEAD, "odometry_std": {"position_m": 0.1, "angle_deg": 1.0}},
    }


def changed(document: Json, path: Path_, value: float) -> Json:
    """Return a copy with one value set; missing parents are created."""
    copy = json.loads(json.dumps(document))
    node: Any = copy
    for key, below in zip(path, (*path[1:], None), strict=True):
        last = below is None
        empty: Any = [] if isinstance(below, int) else {}
        if isinstance(node, list):
            node[:] = [value if last else empty]
            node = node[0]
        elif last:
            node[key] = value
        else:
            node = (
                node.setdefault(key, empty) if node.get(key) is not None else node.__setitem__(key, empty) or node[key]
            )
    return copy


def npy_of(depth: Any) -> bytes:
    stream = io.BytesIO()
    np.save(stream, depth)
    return stream.getvalue()


def depths(parts_of: Parts) -> dict[str, bytes]:
    """Return depth images for which statistics may be undefined."""
    u = np.linspace(0.5, 1.5, 64, dtype=np.float32) * np.ones((48, 1), np.float32)
    return {
        "as it is": parts_of()["depth"],
        "constant": npy_of(np.full((48, 64), 5.0, np.float32)),
        "slanted, whole millimetres": npy_of((np.round(1000 * 5 * u) / 1000).astype(np.float32)),
        "one pixel": npy_of(np.where((np.arange(48)[:, None] == 20) & (np.arange(64) == 30), 5, 0).astype(np.float32)),
        "integers": npy_of((1000 * u).astype(np.uint16)),
        "largest": npy_of(np.full((48, 64), 3e38, np.float32)),
        "smallest": npy_of(np.full((48, 64), 1e-45, np.float32)),
        "not finite": npy_of(
            np.where(np.arange(64) % 2, np.inf, np.nan).astype(np.float32) * np.ones((48, 1), np.float32)
        ),
    }


def finite(value: Any) -> bool:
    """Return whether all numbers of a document are finite. Python's parser accepts NaN, which JSON does not have."""
    if isinstance(value, dict):
        return all(finite(each) for each in value.values())
    if isinstance(value, list):
        return all(finite(each) for each in value)
    return not isinstance(value, float) or math.isfinite(value)


def posted(client: httpx.Client, path: str, parts: dict[str, bytes]) -> tuple[int, Json]:
    response = client.post(path, files={name: (name, data) for name, data in parts.items()})
    document: Json = response.json()
    assert finite(document), document
    return response.status_code, document


def allowed(status: int) -> bool:
    return status == 200 or 400 <= status < 500


def one(client: httpx.Client, parts_of: Parts, document: Json, depth: bytes | None = None) -> tuple[int, Json]:
    parts = parts_of() | {"request": json.dumps(document).encode()}
    return posted(client, "/v1/localize", parts | ({} if depth is None else {"depth": depth}))


LOCALIZE = of("LocalizeRequest")


@pytest.mark.parametrize("number", LOCALIZE, ids=lambda number: number.name)
def test_a_single_request_takes_every_bound_and_names_the_field_beyond_it(
    client: httpx.Client, parts_of: Parts, number: Number
) -> None:
    kinds = ("z", "range", "disparity") if number.path[0] in ("camera", "depth") else ("z",)
    for kind in kinds:
        base = full_request(parts_of, "wgs84" if "wgs84" in number.path else "position")
        base["depth"]["kind"] = kind
        for value, within in number.extremes():
            status, answer = one(client, parts_of, changed(base, number.path, value))
            assert allowed(status), (kind, value, answer)
            if not within:
                assert (status, answer["code"], answer["field"]) == (422, "request", number.name), value


@pytest.mark.parametrize("number", of("SequenceRequest"), ids=lambda number: number.name)
def test_a_sequence_takes_every_bound_and_names_the_field_beyond_it(
    client: httpx.Client, parts_of: Parts, number: Number
) -> None:
    request = full_request(parts_of, "wgs84" if "wgs84" in number.path else "position")
    frame = {name: request.pop(name) for name in ("camera", "depth", "gravity")}
    for value, within in number.extremes():
        document = request | {"frames": [dict(frame), frame | {"T_reference_camera": AHEAD}]}
        path = number.path
        if path[:2] == ("frames", 0):
            changed_frame = changed(document["frames"][1], path[2:], value)
            document["frames"][1], name = changed_frame, ".".join(["frames", "1", *(str(part) for part in path[2:])])
        else:
            document, name = changed(document, path, value), number.name
        pictures = {f"{kind}{k}": parts_of()[kind] for k in (0, 1) for kind in ("rgb", "depth")}
        status, answer = posted(client, "/v1/localize/sequence", pictures | {"request": json.dumps(document).encode()})
        assert allowed(status), (value, answer)
        if not within:
            assert (status, answer["code"], answer["field"]) == (422, "request", name), value


@given(st.data())
@settings(max_examples=150, deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck))
def test_bounds_of_several_fields_at_once(client: httpx.Client, parts_of: Parts, data: st.DataObject) -> None:
    """For two extreme values, a product or a quotient may be infinite or NaN."""
    document = full_request(parts_of, data.draw(st.sampled_from(["position", "wgs84"])))
    document["depth"]["kind"] = data.draw(st.sampled_from(["z", "range", "disparity"]))
    document["options"]["refine"] = data.draw(st.booleans())
    here = [number for number in LOCALIZE if number.path[0] != "prior" or number.path[1] in document["prior"]]
    for number in data.draw(st.lists(st.sampled_from(here), min_size=1, max_size=6, unique_by=lambda n: n.path)):
        value = data.draw(st.sampled_from([value for value, within in number.extremes() if within]))
        document = changed(document, number.path, value)
    camera = document["camera"]
    camera["fx"] = min(
        max(camera["fx"], 0.02 * camera["width"]), 100 * camera["width"]
    )  # else the camera alone is refused
    camera["fy"] = min(max(camera["fy"], 0.02 * camera["height"]), 100 * camera["height"])
    status, answer = one(client, parts_of, document, data.draw(st.sampled_from(list(depths(parts_of).values()))))
    assert allowed(status), answer


@given(st.data())
@settings(max_examples=150, deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck))
def test_any_lens_is_answered_with_finite_numbers_or_refused(
    client: httpx.Client, parts_of: Parts, data: st.DataObject
) -> None:
    document = full_request(parts_of)
    model = data.draw(st.sampled_from(list(COEFFICIENTS)))
    count = data.draw(st.sampled_from(COEFFICIENTS[model]))
    share = data.draw(st.sampled_from([1e-4, 1e-2, 1.0]))
    document["camera"] |= {
        "distortion_model": model,
        "distortion": [share * data.draw(st.floats(-limit, limit)) for _, limit in LIMITS[model][:count]],
        "fx": 64 * data.draw(st.floats(0.02, 3)),
        "fy": 48 * data.draw(st.floats(0.02, 3)),
        "cx": data.draw(st.floats(-64, 128)),
        "cy": data.draw(st.floats(-48, 96)),
    }
    document["depth"]["kind"] = data.draw(st.sampled_from(["z", "range"]))
    status, answer = one(client, parts_of, document, data.draw(st.sampled_from(list(depths(parts_of).values()))))
    assert allowed(status), answer


@pytest.mark.parametrize("kind", ["z", "range", "disparity"])
def test_pictures_on_which_a_statistic_vanishes_are_answered_or_refused(
    client: httpx.Client, parts_of: Parts, kind: str
) -> None:
    base = full_request(parts_of)
    base["depth"] |= {"kind": kind, "scale_m": 0.01 if kind == "disparity" else 1}
    for name, depth in depths(parts_of).items():
        status, answer = one(client, parts_of, base, depth)
        assert allowed(status), (name, answer)


def test_the_longest_strip_that_is_taken_costs_no_more_than_another_picture(
    client: httpx.Client, parts_of: Parts
) -> None:
    """The map is rendered 80 pixels wide with the aspect of the image. For 2 x 32768 pixels, each pose would take 400 MiB."""
    import cv2

    for width, height, taken in ((2, 32, True), (32, 2, True), (2, 33, False), (2, 32768, False)):
        document = full_request(parts_of)
        document["camera"] |= {
            "width": width,
            "height": height,
            "fx": width / 2,
            "fy": height / 2,
            "cx": width / 2,
            "cy": height / 2,
        }
        size = (max(48, 24 * height // width), max(48, 24 * width // height)) if taken else (8, 8)
        parts = {
            "rgb": cv2.imencode(".png", np.full((*size, 3), 99, np.uint8))[1].tobytes(),
            "depth": npy_of(np.full(size, 5.0, np.float32)),
            "request": json.dumps(document).encode(),
        }
        status, answer = posted(client, "/v1/localize", parts)
        assert allowed(status), answer
        assert (answer.get("field") == "camera.height") is not taken


@pytest.mark.parametrize("number", of("GeoPoseRequest"), ids=lambda number: number.name)
def test_the_geopose_protocol_takes_every_bound_and_names_the_field_beyond_it(
    client: httpx.Client, parts_of: Parts, number: Number
) -> None:
    import base64

    def reading(name: str, part: str) -> Json:
        return {
            "sensorId": part,
            "imageFormat": name,
            "size": [64, 48],
            "imageBytes": base64.b64encode(parts_of()[part]).decode(),
            "params": {"model": "PINHOLE", "modelParams": [32, 32, 32, 24], "minMaxDepth": [0.1, 40]},
            "imageOrientation": {"mirrored": False, "rotation": 0},
        }

    base: Json = {
        "sensorReadings": {"cameraReadings": [reading("RGBA32", "rgb"), reading("DEPTH", "depth")]},
        "priorPoses": [],
    }
    for value, within in number.extremes():
        document = json.loads(json.dumps(base))
        parts = list(number.path)
        # Of a reading that is there one number changes; any other list holds one element, made on the way.
        if parts[:2] == ["sensorReadings", "cameraReadings"]:
            readings = document["sensorReadings"]["cameraReadings"]
            inside = readings[0]
            for key in parts[3:-1]:
                inside = inside[key]
            inside[parts[-1]] = value
        else:
            if parts[0] == "priorPoses":
                geopose = {
                    "position": {"lat": 52.52, "lon": 13.4, "h": 0},
                    "quaternion": {"x": 0.5, "y": 0.5, "z": 0.5, "w": 0.5},
                }
                document["priorPoses"] = [{"accuracy": {"position": 1, "orientation": 1}, "geopose": geopose}]
            if parts[:2] == ["sensorReadings", "geolocationReadings"]:
                document["sensorReadings"]["geolocationReadings"] = [
                    {"latitude": 52.52, "longitude": 13.4, "accuracy": 5}
                ]
            if parts[:2] == ["sensorReadings", "accelerometerReadings"]:
                document["sensorReadings"]["accelerometerReadings"] = [{"x": 0.1, "y": 9.8, "z": 0.1}]
            inside = document
            for key in parts[:-1]:
                inside = inside[key]
            inside[parts[-1]] = value
        response = client.post("/geopose", json=document)
        assert allowed(response.status_code), (value, response.text)
        assert finite(response.json())
        if not within:
            assert (response.status_code, response.json()["field"]) == (422, number.name), value


# The same numbers as the proto names them; all pass through the same models.


def numbers_of(descriptor: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    for field in descriptor.fields:
        if field.message_type is not None:
            yield from numbers_of(field.message_type, (*path, field.name))
        elif field.cpp_type in (
            FieldDescriptor.CPPTYPE_DOUBLE,
            FieldDescriptor.CPPTYPE_FLOAT,
            FieldDescriptor.CPPTYPE_UINT32,
        ):
            yield (*path, field.name)


PROTO = list(numbers_of(pb.LocalizeRequest.DESCRIPTOR))
#: A value that no bound holds.
BEYOND = (math.inf, -math.inf, math.nan, 1e300, -1e300)


def test_the_proto_has_as_many_numbers_as_the_schema() -> None:
    assert len(PROTO) == len(LOCALIZE)


@pytest.fixture(scope="module")
def localize(bundle_path: Path) -> Iterator[Callable[[pb.LocalizeRequest], pb.LocalizeResponse]]:
    engine = Engine.open(Settings(maps=(bundle_path,), threads=1))
    server = GrpcServer(engine, host="127.0.0.1", port=0)
    server.start()
    with grpc.insecure_channel(f"127.0.0.1:{server.port}") as channel:
        yield channel.unary_unary(
            f"/{SERVICE}/Localize",
            request_serializer=pb.LocalizeRequest.SerializeToString,
            response_deserializer=pb.LocalizeResponse.FromString,
        )
    server.stop(grace_s=0)
    engine.close()


@pytest.mark.parametrize("path", PROTO, ids=".".join)
def test_a_message_with_a_number_beyond_every_bound_is_refused(
    localize: Any, parts_of: Parts, path: tuple[str, ...]
) -> None:
    parts = parts_of()
    whole = path[-1] in ("width", "height", "neighbours")
    for value in (0, 2**32 - 1) if whole else BEYOND:
        message = pb.LocalizeRequest(
            rgb=parts["rgb"],
            depth=parts["depth"],
            depth_format=pb.DepthFormat(scale_m=1),
            camera=pb.Camera(width=64, height=48, fx=32, fy=32, cx=31.5, cy=23.5),
            vehicle_from_camera=AHEAD if path[0] == "vehicle_from_camera" else None,
        )
        inside: Message = message
        for name in path[:-1]:
            inside = getattr(inside, name)
            inside.SetInParent()
        if isinstance(inside, pb.Camera) and path[-1] == "distortion":
            inside.distortion.append(value)
        else:
            setattr(inside, path[-1], value)
        with pytest.raises(grpc.RpcError) as caught:
            localize(message, timeout=20)
        assert caught.value.code() == grpc.StatusCode.INVALID_ARGUMENT, (value, caught.value.details())
        assert path[-1] in str(caught.value.details())
