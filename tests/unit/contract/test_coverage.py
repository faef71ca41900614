import json

import numpy as np
import pytest

from service.contract import coverage
from service.contract.coverage import coverage_geojson, covered
from service.maps.reader import MapBundle


@pytest.fixture(autouse=True)
def counted(monkeypatch):
    """Constants that these tests assume."""
    monkeypatch.setattr(coverage, "CELL_M", 5.0)
    monkeypatch.setattr(coverage, "REACH_M", 7.5)


def test_one_place_covers_the_cells_around_it():
    """The place is at the centre of a cell. Centres within 7.5 m are covered: 0 and 5 m along an axis, (5, 5) at 7.07 m."""
    assert covered(np.array([[2.5, 2.5]])) == [(-5, -5, 10, 0), (-5, 0, 10, 5), (-5, 5, 10, 10)]


def test_places_far_apart_are_not_joined_and_near_ones_are():
    apart = covered(np.array([[2.5, 2.5], [102.5, 2.5]]))
    assert len(apart) == 6
    joined = covered(np.array([[2.5, 2.5], [17.5, 2.5]]))
    assert joined == [(-5, -5, 25, 0), (-5, 0, 25, 5), (-5, 5, 25, 10)]


def test_no_cell_is_covered_twice_and_every_place_lies_in_one():
    places = np.random.default_rng(0).uniform(-60, 60, (80, 2))
    rectangles = np.array(covered(places))
    inside = (
        (places[:, None, 0] >= rectangles[:, 0])
        & (places[:, None, 0] < rectangles[:, 2])
        & (places[:, None, 1] >= rectangles[:, 1])
        & (places[:, None, 1] < rectangles[:, 3])
    )
    assert (inside.sum(axis=1) == 1).all()


def test_a_map_without_georeference_is_described_in_local_metres(bundle_path):
    bundle = MapBundle.open(bundle_path)
    (feature,) = json.loads(coverage_geojson([bundle]))["features"]
    assert feature["properties"] == {
        "map": "tiny",
        "version": bundle.manifest.version,
        "frame": "map",
        "places": len(bundle.T_map_place),
        "reach_m": 7.5,
    }
    for (ring,) in feature["geometry"]["coordinates"]:
        assert ring[0] == ring[-1]
        (x0, y0), (x1, _), (_, y1) = ring[0], ring[1], ring[2]
        assert x1 > x0  # counter-clockwise: first along x, then along y
        assert y1 > y0


def test_no_maps_is_an_empty_collection():
    assert json.loads(coverage_geojson([])) == {"type": "FeatureCollection", "features": []}
