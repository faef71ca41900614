"""Nearby positions have the same cell, and the client sends it."""

from collections.abc import Callable
from typing import Any

import httpx
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.client import Client, PinholeCamera, Track
from service.client.cells import HEADER, cell_of
from service.contract import schema


def at(x: float, y: float) -> schema.Prior:
    return schema.Prior(position=schema.PriorPosition(x=x, y=y))


@pytest.mark.parametrize(
    ("prior", "map_name", "cell"),
    [
        (at(10.0, 999.0), None, "map-0-0"),
        (at(-1.0, 1000.0), "town", "town-map--1-1"),
        (at(0.0, 0.0), "town@3f9c2a7be01d4586", "town-map-0-0"),
        (at(5.0, 5.0), "Zürich", "Z%C3%BCrich-map-0-0"),
        (schema.Prior(wgs84=schema.PriorWgs84(latitude_deg=49.016, longitude_deg=-8.421)), None, "earth-4901--843"),
    ],
)
def test_the_cell_of_a_prior(prior: schema.Prior, map_name: str | None, cell: str) -> None:
    assert cell_of(prior, map_name) == cell


@given(st.floats(-1e7, 1e7), st.floats(-1e7, 1e7))
def test_a_cell_is_a_header_value(x: float, y: float) -> None:
    cell = cell_of(at(x, y), "a-b.c")
    assert cell.isascii()
    assert cell.isprintable()
    assert len(cell) < 64


@pytest.mark.parametrize("prior", [None, schema.Prior(heading_deg=10.0)])
def test_requests_without_a_position_spread(prior: schema.Prior | None) -> None:
    assert len({cell_of(prior, "town") for _ in range(20)}) == 20


Json = Callable[..., dict[str, Any]]


def pose_at(x: float, y: float) -> dict[str, Any]:
    return {
        "position": {"x": x, "y": y, "z": 1.0},
        "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
        "heading_deg": 0.0,
        "covariance": None,
    }


def belief_at(*positions: tuple[float, float]) -> dict[str, Any]:
    modes = [{"pose": pose_at(*each), "weight": 0.3, "number": n, "unseen": 0} for n, each in enumerate(positions)]
    return {"epoch": 0, "modes": modes, "elsewhere": 0.1, "outside": 0.0, "token": "t"}


LOST = {
    "status": "AMBIGUOUS",
    "pose": None,
    "street": None,
    "spread": {
        "mean": {"x": 0.0, "y": 0.0, "z": 0.0},
        "covariance": [1.0, 0, 0, 0, 1.0, 0, 0, 0, 1.0],
        "heading_std_deg": 20.0,
        "hypotheses_weight": 0.75,
    },
}


@pytest.mark.parametrize(
    ("prior", "changed", "cell"),
    [
        (None, {"pose": pose_at(2500.0, -1.0)}, "town-map-2--1"),
        (None, {"pose": pose_at(2500.0, -1.0), "belief": belief_at((0.0, 0.0))}, "town-map-2--1"),
        (None, LOST | {"belief": belief_at((4000.0, 999.0), (0.0, 0.0))}, "town-map-4-0"),  # the first is the likeliest
        (schema.Prior(heading_deg=10.0), {"pose": pose_at(2500.0, -1.0)}, "town-map-2--1"),
        (at(10.0, 10.0), {"pose": pose_at(2500.0, -1.0)}, "town-map-0-0"),  # the prior is newer than the answer
    ],
)
def test_the_cell_of_a_track_is_that_of_its_last_answer(
    answer_json: Json, prior: schema.Prior | None, changed: dict[str, Any], cell: str
) -> None:
    assert cell_of(prior, "town", schema.LocalizeAnswer.model_validate(answer_json(**changed))) == cell


@pytest.mark.parametrize("belief", [None, belief_at()])
def test_a_track_without_a_position_spreads(answer_json: Json, belief: dict[str, Any] | None) -> None:
    before = schema.LocalizeAnswer.model_validate(answer_json(**LOST, belief=belief))
    assert len({cell_of(None, "town", before) for _ in range(20)}) == 20


def test_a_client_sends_the_frames_of_a_robot_to_the_cell_of_its_last_answer(answer_json: Json) -> None:
    answers = iter([(1.0, 2.0), (990.0, 2.0), (1001.0, 2.0), (1012.0, 2.0)])
    cells: list[str] = []

    def handler(request: httpx.Request) -> httpx.Response:
        cells.append(request.headers[HEADER])
        position = next(answers)
        return httpx.Response(200, json=answer_json(pose=pose_at(*position), belief=belief_at(position)))

    rgb, depth, camera = np.full((4, 6, 3), 7, np.uint8), np.full((4, 6), 2.5), PinholeCamera(6, 4, 3.0, 3.0, 2.5, 1.5)
    with Client("http://x:1", transport=httpx.MockTransport(handler)) as client:
        answer = client.localize(rgb, depth, camera, map="town", track=Track())
        for _ in range(3):
            track = Track(before=answer, T_previous_camera=np.eye(4))
            answer = client.localize(rgb, depth, camera, map="town", track=track)
    assert not cells[0].startswith("town-map-")  # nothing is known yet
    assert cells[1:] == ["town-map-0-0", "town-map-0-0", "town-map-1-0"]
