"""The two maps of requests with a prior: a city across the corner of four tiles, and copies of it."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.report import Report
from benchmarks.scale import served
from model_training.mapping.tile_area import Square, TileArea
from service.imaging.view_grid import ViewGrid
from service.localization.localizer import Localizer
from service.maps.manifest import read_manifest
from service.maps.reader import MapBundle
from service.maps.tiles import TiledMap
from service.registration.surfel_map import SurfelMap
from service.retrieval.prior import Prior

TILE_M = 50.0


@pytest.fixture(scope="module")
def made(stock_map: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Two by two cities in tiles of 50 m, and one city."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(served, "TILE_M", TILE_M)
        patch.setattr(served, "SIDE", 2)
        patch.setattr(served, "BEYOND_M", 10.0)
        patch.setattr(served, "APART", 6)
        return served.shifted_maps(MapBundle.open(stock_map), tmp_path_factory.mktemp("served"))


def test_the_city_begins_ten_metres_before_the_corner_of_four_tiles(made: Any, stock_map: Path) -> None:
    shifts, maps = made
    lowest = TiledMap.open(maps[served.ONE]).T_map_place[:, :2, 3].min(axis=0)
    np.testing.assert_allclose(lowest, [40.0, 40.0])
    low = MapBundle.open(stock_map).T_map_place[:, :2, 3].min(axis=0)
    expected = [[0, 0], [0, 300], [300, 0], [300, 300]]
    np.testing.assert_allclose(np.array(shifts) + low - [40.0, 40.0], expected, atol=1e-9)


def test_both_maps_have_the_same_city_and_no_tile_has_two(made: Any, stock_map: Path) -> None:
    _, maps = made
    one, many = read_manifest(maps[served.ONE]), read_manifest(maps[served.MANY])
    places = MapBundle.open(stock_map).manifest.counts.places
    assert one.counts.places == places
    assert many.counts.places == 4 * places
    assert len(many.tiles) == 4 * len(one.tiles) > 4
    of_one = {(tile.column, tile.row): tile.counts.places for tile in one.tiles}
    of_many = {(tile.column, tile.row): tile.counts.places for tile in many.tiles}
    shifted = {(c + x, r + y): places for (c, r), places in of_one.items() for x in (0, 6) for y in (0, 6)}
    assert of_many == shifted


def test_a_tile_has_the_cloud_of_its_area(made: Any) -> None:
    opened = TiledMap.open(made[1][served.ONE])
    squares = {(tile.column, tile.row) for tile in opened.manifest.tiles}
    for number, tile in enumerate(opened.manifest.tiles):
        cloud = opened.tiles.get(number).cloud
        assert isinstance(cloud, SurfelMap)
        inside = TileArea(Square(tile.column, tile.row, TILE_M), squares, 0.3).is_in_cloud(
            cloud.unpacked(slice(None))["xyz"] + cloud.origin_m
        )
        assert inside.mean() > 0.999  # rounding moves surfels over the edge
    assert max(opened.tiles.get(number).manifest.counts.cloud_points for number in range(len(opened.tiles))) > 100


def test_a_query_gets_the_answer_of_the_city_in_both_maps(made: Any, stock_map: Path, small_dataset: Any) -> None:
    shifts, maps = made
    frame = next(iter(small_dataset.queries("drive1_precise")))
    xy = frame.T_map_camera[:2, 3]
    answers = []
    for path, shift in ((stock_map, np.zeros(2)), (maps[served.ONE], shifts[0]), (maps[served.MANY], shifts[3])):
        bundle = MapBundle.open(path) if path == stock_map else TiledMap.open(path)
        asked = replace(frame.query(bundle.grid), prior=Prior(position_m=xy + shift, position_std_m=5.0))
        answers.append(Localizer.open(bundle).localize(asked).T_map_camera_guess[:2, 3] - shift)
    np.testing.assert_allclose(answers[1], answers[0], atol=0.02)
    np.testing.assert_allclose(answers[2], answers[1], atol=1e-3)


def test_a_prior_touches_the_tiles_in_its_radius(small_dataset: Any) -> None:
    """The radius is 4 x 5 m + 50 m = 70 m. From (60, 60) the tiles beside are 60 m away, the diagonal one 85 m."""
    query = next(iter(small_dataset.queries("drive1_precise"))).query(ViewGrid())
    squares_m = np.array([[x, y, x + 500.0, y + 500.0] for x in (-500.0, 0.0) for y in (-500.0, 0.0)])

    def touched(x: float, y: float) -> int:
        prior = Prior(position_m=np.array([x, y]), position_std_m=5.0)
        return served.touched_tiles(squares_m, replace(query, prior=prior))

    assert touched(100.0, 100.0) == 1
    assert touched(60.0, 100.0) == 2
    assert touched(60.0, 60.0) == 3
    assert touched(-40.0, 40.0) == 4
    with pytest.raises(ValueError, match="prior: the query has none"):
        served.touched_tiles(squares_m, query)


def test_the_rows_say_how_many_tiles_the_priors_touch(
    made: Any, small_dataset: Any, monkeypatch: pytest.MonkeyPatch, stock_map: Path
) -> None:
    monkeypatch.setattr(served, "ROBOTS", 2)
    monkeypatch.setattr(served, "RUN", 2)
    report = Report("scale", "make bench-scale")
    shifts, maps = made
    served._measure(report, served._queries(small_dataset, MapBundle.open(stock_map)), shifts, maps)
    found = {row["id"]: row for row in report.rows}
    assert set(found) == {
        *(f"serve.with_prior.{name}.{row}" for name in maps for row in ("p50_ms", "p99_ms", "within_1_m")),
        "serve.p99_with_prior",
    }
    assert found["serve.p99_with_prior"]["n"] == 4
    assert "4 cities over one. Of the priors, 100% touch more than one tile" in found["serve.p99_with_prior"]["why"]
