import json

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from model_training.streets.collection import collection_of, write_streets
from model_training.streets.named_street import NamedStreet
from service.errors import BundleError, DatasetError
from service.maps.streets import Streets


def street_of(name, *box, **more):
    return NamedStreet(name, name, shapely.box(*box), **more)


def read(streets):
    return Streets.from_geojson(json.loads(json.dumps(collection_of(streets).document)))


def test_the_service_reads_what_was_made(tmp_path):
    streets = [
        street_of("High Street", 0, 0, 100, 8),
        NamedStreet("4", "End of 4", shapely.box(0, 50, 9, 59), section="end"),
    ]
    written = write_streets(tmp_path / "streets.geojson", collection_of(streets).document)
    first, second = Streets.from_geojson(json.loads((tmp_path / "streets.geojson").read_text())).features
    assert (first.id, first.street, first.section, first.name, first.class_index) == (
        "high-street",
        "High Street",
        None,
        "High Street",
        0,
    )
    assert (second.id, second.street, second.section, second.name, second.class_index) == (
        "4-end",
        "4",
        "end",
        "End of 4",
        1,
    )
    assert written.index_at(np.array([50.0, 4.0])) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["streets.geojson"]


def test_the_earlier_street_keeps_a_crossing():
    collection = collection_of([street_of("a", -50, -4, 50, 4), street_of("b", -4, -50, 4, 50)])
    ground = [shapely.geometry.shape(feature["geometry"]) for feature in collection.document["features"]]
    assert collection.overlap_m2 == pytest.approx(64, rel=0.01)
    assert [part.area for part in ground] == pytest.approx([800, 736], rel=0.01)
    assert ground[0].intersection(ground[1]).area == 0


@settings(max_examples=50, deadline=None)
@given(st.lists(st.tuples(*[st.integers(0, 40)] * 2, *[st.integers(2, 30)] * 2), min_size=1, max_size=6))
def test_no_point_lies_in_two_streets(boxes):
    collection = collection_of([street_of("s", x, y, x + w, y + h) for x, y, w, h in boxes])
    ground = [shapely.geometry.shape(feature["geometry"]) for feature in collection.document["features"]]
    assert sum(part.area for part in ground) == pytest.approx(shapely.union_all(ground).area, abs=1e-6)
    assert len({feature["properties"]["id"] for feature in collection.document["features"]}) == len(ground)


@settings(max_examples=50, deadline=None)
@given(st.floats(0, 3.14), st.floats(0, 1))
def test_streets_that_follow_one_another_leave_no_gap(heading, along):
    turned = [
        shapely.affinity.rotate(shapely.box(x, -4, x + 50, 4), heading, origin=(0, 0), use_radians=True)
        for x in (0, 50)
    ]
    streets = read([NamedStreet(str(number), str(number), ground) for number, ground in enumerate(turned)])
    across = (along - 0.5) * 7.9
    end = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]]) @ [50.0, across]
    assert streets.index_at(end) >= 0


def test_a_street_within_others_is_left_out_and_reported():
    collection = collection_of(
        [street_of("a", 0, 0, 50, 50), street_of("b", 10, 10, 20, 20), street_of("c", 80, 80, 80.5, 80.5)]
    )
    assert collection.dropped == ("b is completely inside other streets", "c covers less than 1 m2")


def test_a_straight_edge_keeps_only_its_corners():
    x = np.arange(0.0, 100.5, 0.5)
    ring = np.concatenate([np.column_stack([x, 0 * x]), np.column_stack([x[::-1], 0 * x + 8])])
    collection = collection_of([NamedStreet("a", "a", shapely.Polygon(ring))])
    assert len(collection.document["features"][0]["geometry"]["coordinates"][0]) == 5


def test_ids_are_made_of_names_and_never_twice():
    streets = [
        street_of("Abbey Road!", 0, 0, 9, 9),
        street_of("abbey road", 20, 0, 29, 9),
        street_of("???", 40, 0, 49, 9),
    ]
    streets.append(street_of("Straße", 60, 0, 69, 9, id="abbey-road-2"))
    assert [street.id for street in read(streets).features] == ["abbey-road", "abbey-road-3", "street", "abbey-road-2"]


def test_an_id_that_two_streets_bring_is_refused():
    with pytest.raises(DatasetError, match="two streets have the id 'x'"):
        collection_of([street_of("a", 0, 0, 9, 9, id="x"), street_of("b", 20, 0, 29, 9, id="x")])


def test_ground_of_less_than_a_metre_asks_whether_it_is_in_degrees():
    with pytest.raises(DatasetError, match=r"no street covers any area.*if the coordinates are degrees"):
        collection_of([street_of("a", 9.99, 48.4, 9.991, 48.401)])


def test_a_file_that_is_there_stays_unless_it_may_go(tmp_path):
    path, document = tmp_path / "streets.geojson", collection_of([street_of("a", 0, 0, 9, 9)]).document
    path.write_text("mine")
    with pytest.raises(DatasetError, match="exists; pass --replace"):
        write_streets(path, document)
    assert path.read_text() == "mine"
    assert len(write_streets(path, document, replace=True)) == 1


def test_a_bundle_that_the_service_would_refuse_is_not_written(tmp_path):
    with pytest.raises(BundleError):
        write_streets(tmp_path / "streets.geojson", {"type": "FeatureCollection", "features": [{}]})
    assert list(tmp_path.iterdir()) == []
