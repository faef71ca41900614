"""Every option has an effect: the code reads each field of a request or setting, and another value changes the result."""

import ast
import dataclasses
import json
from collections.abc import Callable, Iterator
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import BaseModel

from service.contract import schema
from service.contract.convert import parsed, query_from, sequence_from
from service.errors import StreetfixError
from service.retrieval.query import Query
from service.runtime.engine import EncodedQuery
from service.runtime.settings import Limits, Settings

SERVICE = Path(__file__).parents[3] / "service"
Json = dict[str, Any]
T = {"position": {"x": 1, "y": 2, "z": 3}, "orientation": {"x": 0.1, "y": 0.2, "z": 0.3, "w": 0.9}}
FRAME: Json = {
    "camera": {
        "model": "PINHOLE",
        "width": 64,
        "height": 48,
        "fx": 32,
        "fy": 32,
        "cx": 31.5,
        "cy": 23.5,
        "distortion": [-0.1, 0.02, 0, 0],
        "distortion_model": "brown_conrady",
    },
    "depth": {"scale_m": 0.001, "kind": "z", "encoding": "auto", "max_range_m": 40, "baseline_m": 0.12},
    "gravity": {"x": 0.1, "y": 1, "z": 0.1},
}
ABOUT: Json = {
    "map": "tiny",
    "T_vehicle_camera": T,
    "options": {"neighbours": 5, "refine": True, "false_accept_rate": 0.02},
}
POSITION = {"position": {"x": 1, "y": 2, "std_m": 3}, "heading_deg": 10, "heading_std_deg": 20}
WGS84 = {"wgs84": {"latitude_deg": 1, "longitude_deg": 2, "std_m": 3}, "heading_deg": 10, "heading_std_deg": 20}


def leaves(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    if isinstance(value, (dict, list)):
        for key, inner in value.items() if isinstance(value, dict) else enumerate(value):
            yield from leaves(inner, (*path, key))
    else:
        yield path


def fields_of(model: type[BaseModel], path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """Return the paths of all leaf fields of a model. List elements have no name of their own."""
    for name, field in model.model_fields.items():
        inner = [each for each in _types(field.annotation) if isinstance(each, type) and issubclass(each, BaseModel)]
        if inner:
            for each in inner:
                yield from fields_of(each, (*path, name))
        else:
            yield (*path, name)


def _types(annotation: Any) -> Iterator[Any]:
    yield annotation
    for each in getattr(annotation, "__args__", ()):
        yield from _types(each)


def named(document: Json) -> set[tuple[str, ...]]:
    """Return the leaves of a document without the indices of list elements."""
    return {tuple(key for key in path if isinstance(key, str)) for path in leaves(document)}


#: The height of the camera is said, or follows from the vehicle.
HIGH = FRAME | {"camera": FRAME["camera"] | {"height_m": 0.3, "height_std_m": 0.02}}
ON_GROUND = {"vehicle_base_on_ground": True}
ODOMETRY_STD = {"position_m": 0.2, "angle_deg": 1.5}
TRACK = {"track": {"belief": "AAAA", "T_previous_camera": T, "odometry_std": ODOMETRY_STD}}
ALONE = [HIGH | ABOUT | TRACK | {"prior": POSITION}, FRAME | ABOUT | ON_GROUND | {"prior": WGS84}]
SEQUENCES = [
    ABOUT | {"frames": [frame, frame | {"T_reference_camera": T}]} | more
    for frame, more in ((HIGH, TRACK | {"prior": POSITION}), (FRAME, ON_GROUND | {"prior": WGS84}))
]


def test_the_documents_describe_every_request_field() -> None:
    assert set.union(*map(named, ALONE)) == set(fields_of(schema.LocalizeRequest))
    assert set.union(*map(named, SEQUENCES)) == set(fields_of(schema.SequenceRequest))


def other(value: Any, path: tuple[Any, ...]) -> Any:
    """Return another valid value, or an invalid one if there is no other valid value."""
    told = {
        "kind": "range",
        "encoding": "carla",
        "map": "west",
        "model": "OPENCV",
        "belief": "BBBB",
        "distortion_model": "kannala_brandt",
    }
    if path[-1] in told:
        return told[path[-1]]
    if isinstance(value, bool):
        return not value
    return value + 1 if isinstance(value, int) else 0.7 * value


def with_other(document: Json, path: tuple[Any, ...]) -> Json:
    copy: Json = json.loads(json.dumps(document))
    node: Any = copy
    for key in path[:-1]:
        node = node[key]
    node[path[-1]] = other(node[path[-1]], path)
    return copy


def plain(value: Any) -> Any:
    """Convert a value to something comparable."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    return [plain(each) for each in value] if isinstance(value, tuple) else value


def asked_alone(document: Json) -> Any:
    """Return the query that the engine receives, or the refusal."""
    try:
        return plain(query_from(parsed(json.dumps(document).encode(), schema.LocalizeRequest), rgb=b"", depth=b""))
    except StreetfixError as error:
        return error.message


def asked_in_sequence(document: Json) -> Any:
    try:
        request = parsed(json.dumps(document).encode(), schema.SequenceRequest)
        return plain(sequence_from(request, [(b"", b"")] * len(request.frames)))
    except StreetfixError as error:
        return error.message


@pytest.mark.parametrize(
    ("asked", "document", "path"),
    [
        pytest.param(asked, document, path, id=f"{asked.__name__}-{'.'.join(map(str, path))}")
        for asked, documents in ((asked_alone, ALONE), (asked_in_sequence, SEQUENCES))
        for document in documents
        for path in leaves(document)
    ],
)
def test_another_value_of_any_field_changes_the_query_or_is_refused(
    asked: Callable[[Json], Any], document: Json, path: tuple[Any, ...]
) -> None:
    as_it_is = asked(document)
    assert not isinstance(as_it_is, str), as_it_is
    assert asked(with_other(document, path)) != as_it_is


@pytest.mark.parametrize(
    ("changed", "remedy"),
    [
        ({"model": "OPENCV"}, "send the lens as distortion_model and distortion, or rectify both images"),
        ({"distortion": [0.1]}, "send 4, 5, 8, 12 or 14 of k1, k2, p1, p2, k3"),
        ({"distortion": [0.1, 0, 5, 0]}, "p1 = 5 is no lens, because it exceeds 1; check the order"),
        ({"distortion": [], "distortion_model": "kannala_brandt"}, "send 4 of k1, k2, k3, k4"),
        ({"distortion": [0, 0, 0, 0, 0], "distortion_model": "kannala_brandt"}, "send 4 of k1, k2, k3, k4"),
    ],
)
def test_a_lens_that_is_none_is_refused_with_the_remedy(changed: Json, remedy: str) -> None:
    refused = asked_alone(ALONE[0] | {"camera": FRAME["camera"] | changed})
    assert f"camera.{next(iter(changed))}" in refused
    assert remedy in refused


def test_zeros_are_no_distortion_but_a_fisheye_lens() -> None:
    camera = FRAME["camera"] | {"distortion": [0, 0, 0, 0]}
    for changed in ({}, {"distortion": []}, {"distortion": [0.0] * 5}):
        told = asked_alone(ALONE[0] | {"camera": camera | changed})["camera"]
        assert (told["distortion"], told["distortion_model"]) == ([], "brown_conrady")
    told = asked_alone(ALONE[0] | {"camera": camera | {"distortion_model": "kannala_brandt"}})["camera"]
    assert (told["distortion"], told["distortion_model"]) == ([0.0] * 4, "kannala_brandt")


def classes_of_options() -> Iterator[type]:
    """Return all settings classes of the service by their suffix."""
    yield from (EncodedQuery, Query, Limits, Settings)
    for path in sorted(SERVICE.rglob("*.py")):
        if "generated" in path.parts:
            continue
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.ClassDef) and node.name.endswith(
                ("Settings", "Options", "Weights", "Model", "Policy")
            ):
                module = ".".join(("service", *path.relative_to(SERVICE).with_suffix("").parts))
                kind = getattr(import_module(module), node.name)
                if issubclass(kind, BaseModel) or dataclasses.is_dataclass(kind):
                    yield kind


@cache
def used_names() -> frozenset[str]:
    """Return all names that the service reads as an attribute or writes in a string (fields of C structs).

    Docstrings are longer than names. The declaration of a field does not count.
    """
    found = set()
    for path in SERVICE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Load):
                found.add(node.attr)
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                found.add(node.value)
    return frozenset(found)


@pytest.mark.parametrize("kind", dict.fromkeys(classes_of_options()), ids=lambda kind: kind.__name__)
def test_every_option_is_read_somewhere(kind: Any) -> None:
    names = set(kind.model_fields if issubclass(kind, BaseModel) else kind.__dataclass_fields__)
    assert kind.__name__ == "BeamModel" or names - used_names() == set()  # that one a C struct takes whole (`astuple`)
