import copy
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.errors import BundleError
from service.maps.streets import Streets, _inside

SQUARE = [[0, 0], [10, 0], [10, 10], [0, 10], [0, 0]]
HOLE = [[4, 4], [6, 4], [6, 6], [4, 6], [4, 4]]


def collection(geometry: dict[str, Any], **properties: Any) -> dict[str, Any]:
    good = {"id": "a", "street": "1", "section": None, "name": "Street 1", "class_index": 0}
    return {"type": "FeatureCollection", "features": [{"properties": good | properties, "geometry": geometry}]}


def test_a_point_inside_a_polygon_belongs_to_its_street() -> None:
    streets = Streets.from_geojson(collection({"type": "Polygon", "coordinates": [SQUARE]}))
    assert streets.index_at(np.array([5.0, 5.0])) == 0


def test_a_point_outside_belongs_to_none() -> None:
    streets = Streets.from_geojson(collection({"type": "Polygon", "coordinates": [SQUARE]}))
    assert streets.index_at(np.array([15.0, 5.0])) == -1


def test_a_hole_is_outside() -> None:
    streets = Streets.from_geojson(collection({"type": "Polygon", "coordinates": [SQUARE, HOLE]}))
    assert streets.index_at(np.array([5.0, 5.0])) == -1


def test_every_part_of_a_multipolygon_counts() -> None:
    far = [[x + 100, y] for x, y in SQUARE]
    streets = Streets.from_geojson(collection({"type": "MultiPolygon", "coordinates": [[SQUARE], [far]]}))
    assert [streets.index_at(np.array([x, 5.0])) for x in (5.0, 50.0, 105.0)] == [0, -1, 0]


@given(st.floats(-20, 20), st.floats(-20, 20))
def test_inside_agrees_with_the_inequalities_of_a_rectangle(x: float, y: float) -> None:
    streets = Streets.from_geojson(collection({"type": "Polygon", "coordinates": [SQUARE]}))
    strictly_inside, outside = 0 < x < 10 and 0 < y < 10, not (0 <= x <= 10 and 0 <= y <= 10)
    found = streets.index_at(np.array([x, y])) == 0
    assert found or not strictly_inside
    assert not (found and outside)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda document: document.update(type="Feature"),
        lambda document: document.update(features=None),
        lambda document: document["features"][0]["properties"].pop("section"),
        lambda document: document["features"][0]["properties"].update(section="middle"),
        lambda document: document["features"][0]["properties"].update(class_index="3"),
        lambda document: document["features"][0]["properties"].update(id=7),
        lambda document: document["features"][0]["geometry"].update(type="Point"),
        lambda document: document["features"][0]["geometry"].update(coordinates=[[[0, 0], [1, 1]]]),
        lambda document: document["features"][0]["geometry"].update(coordinates=[[["a", 0]] * 4]),
        lambda document: document["features"][0].update(geometry=None),
    ],
)
def test_a_defective_collection_is_refused(spoil: Callable[[dict[str, Any]], object]) -> None:
    document = copy.deepcopy(collection({"type": "Polygon", "coordinates": [SQUARE]}))
    spoil(document)
    with pytest.raises(BundleError, match=r"streets\.geojson"):
        Streets.from_geojson(document)


@given(seed=st.integers(0, 10**6), far_m=st.sampled_from([0.0, 1e6]))
def test_the_box_of_a_street_does_not_change_which_points_it_contains(seed: int, far_m: float) -> None:
    """Rings of any shape, and points inside, outside, on corners and in line with them."""
    rng = np.random.default_rng(seed)
    rings = [np.round(rng.uniform(0, 20, (int(rng.integers(4, 9)), 2))) + far_m for _ in range(2)]
    street = Streets.from_geojson(
        collection({"type": "MultiPolygon", "coordinates": [[ring.tolist()] for ring in rings]})
    )[0]
    corners = np.concatenate(rings)
    for point in (
        *(rng.uniform(-5, 25, (40, 2)) + far_m),
        *corners,
        *np.stack([corners[:, 0], corners[::-1, 1]], axis=1),
    ):
        assert street.contains(point) == any(_inside(ring, point) for ring in rings)


def test_a_street_without_a_polygon_contains_nothing() -> None:
    streets = Streets.from_geojson(collection({"type": "MultiPolygon", "coordinates": []}))
    assert streets.index_at(np.array([5.0, 5.0])) == -1
