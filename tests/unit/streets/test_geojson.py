import numpy as np
import pytest
import shapely

from model_training.streets.geojson import read_geojson
from model_training.streets.map_frame import MapFrame
from service.errors import DatasetError
from service.geometry.earth import Georeference

SQUARE = [[[0, 0], [10, 0], [10, 10], [0, 10], [0, 0]]]
LINE = [[0, 0], [100, 0]]
NAMED = {"name": "High Street"}


def only(path, **options):
    (street,) = read_geojson(path, **options).streets
    return street


def test_a_polygon_is_taken_as_it_is(geojson):
    street = only(
        geojson(("Polygon", SQUARE, {"name": "End of street 4", "street": "4", "section": "end", "id": "4-end"}))
    )
    assert street.surface.equals(shapely.box(0, 0, 10, 10))
    assert (street.street, street.name, street.section, street.id) == ("4", "End of street 4", "end", "4-end")


@pytest.mark.parametrize(
    ("width", "option", "half"), [(6, None, 3), (6, 20, 3), ("7.5", None, 3.75), (None, 20, 10), (None, None, 4)]
)
def test_a_centre_line_is_as_wide_as_it_says_or_as_the_default(geojson, width, option, half):
    street = only(geojson(("LineString", LINE, NAMED | {"width": width})), width_m=option)
    assert street.surface.equals(shapely.box(0, -half, 100, half))


def test_lines_of_one_name_are_joined_without_a_wedge_missing(geojson):
    street = only(geojson(("LineString", LINE, NAMED), ("MultiLineString", [[[100, 0], [100, 50]]], NAMED)))
    assert street.surface.contains(shapely.Point(101, -1))
    assert len(street.lines) == 2


def test_degrees_become_metres_of_the_map(geojson, ulm):
    corners = [Georeference(**ulm).to_earth(np.array([x, y, 0.0])) for x, y in SQUARE[0]]
    path = geojson(("Polygon", [[[lon, lat] for lat, lon, _ in corners]], NAMED))
    surface = only(path, frame=MapFrame(ulm)).surface
    assert shapely.hausdorff_distance(surface, shapely.box(0, 0, 10, 10)) < 0.01


def test_an_older_files_projection_is_heeded(geojson, ulm):
    import pyproj

    x, y = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:25832", always_xy=True).transform(9.99, 48.4)
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::25832"}}
    street = only(geojson(("LineString", [[x, y], [x + 50, y]], NAMED), crs=crs), frame=MapFrame(ulm))
    np.testing.assert_allclose(street.lines[0].coords[0], [0, 0], atol=0.01)


def test_heights_are_left_out(geojson):
    assert not only(geojson(("LineString", [[0, 0, 400], [9, 0, 401]], NAMED))).surface.has_z


def test_a_polygon_that_crosses_itself_keeps_its_ground(geojson):
    bow = [[[0, 0], [10, 10], [10, 0], [0, 10], [0, 0]]]
    assert only(geojson(("Polygon", bow, NAMED))).surface.area == pytest.approx(50)


def test_omitted_items_are_counted_with_the_reason(geojson, ulm):
    near = [[9.99, 48.4], [9.991, 48.4]]
    path = geojson(
        ("LineString", near, NAMED), ("LineString", near, {}), ("Point", [0, 0], NAMED), ("LineString", LINE, NAMED)
    )
    read = read_geojson(path, frame=MapFrame(ulm))
    assert read.unnamed == 1
    assert [reason.split(",")[0] for reason in read.dropped] == [
        "1 features have no name",
        "1 features have the type Point",
        "1 features are more than 50 km from the map's origin",
    ]


@pytest.mark.parametrize(
    ("features", "said"),
    [
        ([("Point", [0, 0], NAMED)], "no feature is a named polygon or centre line .1 features have the type Point"),
        ([("Polygon", SQUARE, {})], "1 features have no name"),
        ([], "not a FeatureCollection with features"),
        ([("LineString", LINE, NAMED | {"width": 0})], r"features\[0\].properties.width: '0' is not a width"),
        ([("LineString", LINE, NAMED | {"width": "wide"})], "'wide' is not a width"),
        (
            [("Polygon", SQUARE, NAMED | {"id": "a"})] * 2,
            r"features\[1\].properties.id: 'a' is also the id of features\[0\]",
        ),
        ([("Polygon", SQUARE, NAMED | {"section": "middle"})], "'middle' is not beginning, end or null"),
        ([("Polygon", SQUARE, {"name": 4})], "properties.name: '4' is not a text"),
        ([("Polygon", [[[0, 0], [1, 1]]], NAMED)], r"features\[0\].geometry: its coordinates are not a valid Polygon"),
        ([("LineString", [["a", 0], [1, 1]], NAMED)], "its coordinates are not a valid LineString"),
        ([("LineString", [[0, 0]], NAMED)], "its coordinates are not a valid LineString"),
        ([("LineString", None, NAMED)], "cover no area"),
        ([("LineString", [[5, 5], [5, 5]], NAMED)], "cover no area"),
        ([("Polygon", [[[0, 0], [9, 0], [9, 1e308], [0, 0]]], NAMED)], "are more than"),
    ],
)
def test_a_defective_collection_is_refused_by_file_and_feature(geojson, features, said):
    with pytest.raises(DatasetError, match=rf"map\.geojson.*{said}"):
        read_geojson(geojson(*features))


@pytest.mark.parametrize(
    "text",
    ["", "{", "[]", '{"type": "Feature"}', '{"type": "FeatureCollection", "features": [NaN]}', "[" * 100_000, "\x00"],
)
def test_invalid_geojson_is_refused(tmp_path, text):
    (tmp_path / "map.geojson").write_text(text)
    with pytest.raises(DatasetError, match=r"map\.geojson"):
        read_geojson(tmp_path / "map.geojson")


@pytest.mark.parametrize("feature", [None, 3, {"properties": 3}, {"properties": {"name": "a"}, "geometry": 3}])
def test_a_feature_that_is_none_is_refused(tmp_path, feature):
    import json

    (tmp_path / "map.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}))
    with pytest.raises(DatasetError, match=r"map\.geojson"):
        read_geojson(tmp_path / "map.geojson")


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(DatasetError, match=r"none\.geojson: cannot be read"):
        read_geojson(tmp_path / "none.geojson")
