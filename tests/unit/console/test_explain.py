"""Intermediate images of an answer with a known pose."""

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from service.console.explain import POINT_BYTES, Explanation, camera_over, explain, mapped_depth
from service.console.message import explanation_message
from service.console.pictures import depth_picture
from service.contract import schema
from service.contract.convert import parsed, query_from
from service.imaging.view_grid import MAX_RANGE_M, ViewGrid
from service.localization.refine import RefineSettings
from service.registration.surfel_map import SurfelMap
from service.runtime.engine import Engine
from service.runtime.settings import Settings


@pytest.fixture(scope="module")
def engine(bundle_path: Path) -> Iterator[Engine]:
    engine = Engine.open(Settings(maps=(bundle_path,), threads=1))
    yield engine
    engine.close()


def encoded(parts: dict[str, bytes]) -> Any:
    return query_from(parsed(parts["request"], schema.LocalizeRequest), rgb=parts["rgb"], depth=parts["depth"])


@pytest.fixture(scope="module")
def explanation(engine: Engine, parts_of: Callable[..., dict[str, bytes]]) -> Explanation:
    return explain(engine, encoded(parts_of()))


def pixels(png: bytes) -> np.ndarray:
    found = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    assert found is not None
    return found


def test_the_answer_is_the_one_that_localize_gives(
    engine: Engine, explanation: Explanation, parts_of: Callable[..., dict[str, bytes]]
) -> None:
    alone = engine.localize(encoded(parts_of())).answer
    assert np.array_equal(explanation.located.answer.T_map_camera_guess, alone.T_map_camera_guess)
    assert explanation.located.answer.confidence == alone.confidence


def test_the_map_at_the_answer_looks_like_the_query(explanation: Explanation) -> None:
    query, drawn = (pixels(explanation.pictures[name]).astype(int) for name in ("depth", "map_depth"))
    assert query.shape == drawn.shape
    both = (query.sum(axis=2) > 0) & (drawn.sum(axis=2) > 0)
    assert both.mean() > 0.4
    assert np.median(np.abs(query - drawn)[both]) < 40


def test_views_have_the_grids_cells(explanation: Explanation, engine: Engine) -> None:
    grid = engine.registry.get(None).bundle.grid
    for name in ("fused", "view"):
        assert pixels(explanation.pictures[name]).shape == (4 * grid.rows, 4 * grid.columns, 3)


def test_points_lie_where_the_map_has_surfaces(explanation: Explanation, engine: Engine) -> None:
    cloud = engine.registry.get(None).bundle.cloud
    assert isinstance(cloud, SurfelMap)
    records = np.frombuffer(explanation.points, np.dtype([("xyz", "<f4", (3,)), ("rgb", "u1", (4,))]))
    points = records["xyz"][::37] + explanation.origin_m
    surfels = cloud.unpacked(np.s_[:])["xyz"] + cloud.origin_m
    away = np.array([np.linalg.norm(surfels - point, axis=1).min() for point in points])
    assert np.median(away) < 0.3


def test_without_registration_there_is_still_something_to_see(
    engine: Engine, parts_of: Callable[..., dict[str, bytes]]
) -> None:
    found = explain(engine, encoded(parts_of(options={"refine": False})))
    assert found.located.answer.candidates is None
    assert set(found.pictures) == {"depth", "fused", "view", "map_depth"}


def test_the_message_counts_its_points(explanation: Explanation) -> None:
    message = json.loads(explanation_message(explanation).model_dump_json(by_alias=True))
    assert message["points"]["count"] == len(explanation.points) // POINT_BYTES
    assert "register" in message["answer"]["timings_ms"]


def test_scale_and_disparity_offset_are_taken_out(
    explanation: Explanation, frame_with: Callable[..., Any], matches_at: Callable[..., Any]
) -> None:
    candidates = explanation.located.answer.candidates
    assert candidates is not None
    registered = replace(candidates[0].registered, scale=1.1, offset=0.5)
    frame = frame_with(matches_at([[0, 0, 0]], [0], [1]), depth_m=np.full((4, 6), 8.0, np.float32))
    found = mapped_depth(frame, registered, RefineSettings(focal_baseline_px_m=80.0))
    assert np.allclose(found, 8.0 * 1.1 / (1 + 0.5 * 8.0 / 80.0))
    assert mapped_depth(frame, None, RefineSettings()) is frame.query.depth_m


def test_depth_is_red_near_blue_far_and_black_where_unknown() -> None:
    ((near, far, further, unknown),) = depth_picture(np.array([[1.0, MAX_RANGE_M, 99.0, 0.0]], np.float32)).astype(int)
    assert near[0] > near[2]
    assert far[2] > far[0]
    assert np.array_equal(far, further)
    assert not unknown.any()


def test_the_camera_of_a_view_holds_its_corners() -> None:
    grid = ViewGrid()
    camera = camera_over(grid)
    rays = grid.rays_level()[[0, 0, -1, -1], [0, -1, 0, -1]]
    u = camera.cx - camera.fx * rays[:, 1] / rays[:, 0]
    v = camera.cy - camera.fy * rays[:, 2] / rays[:, 0]
    assert ((u >= -0.5) & (u <= camera.width - 0.5)).all()
    assert ((v >= 0) & (v <= camera.height - 1)).all()
