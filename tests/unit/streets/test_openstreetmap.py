import numpy as np
import pytest

from model_training.streets.map_frame import MapFrame
from model_training.streets.openstreetmap import read_openstreetmap
from service.errors import DatasetError
from service.geometry.earth import Georeference


@pytest.fixture
def line(ulm):
    """Return geodetic positions of map coordinates (m)."""

    def places(*points):
        return [Georeference(**ulm).to_earth(np.array([*p, 0.0]))[1::-1] for p in points]

    return places


@pytest.fixture
def read(ulm):
    return lambda path, **options: read_openstreetmap(path, frame=MapFrame(ulm), **options)


def widths_of(read, path, **options):
    return [street.surface.area / 100 for street in read(path, **options).streets]


@pytest.mark.parametrize(
    ("tags", "options", "width"),
    [
        ({}, {"lanes": "driving"}, 6.0),
        ({}, {}, 10.0),
        ({"sidewalk": "no"}, {}, 6.0),
        ({"highway": "service"}, {}, 4.0),
        ({"lanes": "2"}, {"lanes": "driving"}, 6.5),
        ({"lanes": "2", "width": "9.5"}, {"lanes": "driving"}, 9.5),
        ({"width": "9 m"}, {"lanes": "driving"}, 9.0),
        ({"width": "20'"}, {"lanes": "driving"}, 6.096),
        ({"width": "narrow", "lanes": "some"}, {"lanes": "driving"}, 6.0),
        ({}, {"lanes": "driving", "width_m": 7.0}, 7.0),
        ({"width": "9"}, {"lanes": "driving", "width_m": 7.0}, 9.0),
    ],
)
def test_a_way_is_as_wide_as_its_tags_say_or_its_class(osm, line, read, tags, options, width):
    path = osm((line((0, 0), (100, 0)), {"highway": "residential", "name": "Mill Lane"} | tags))
    assert widths_of(read, path, **options) == pytest.approx([width], rel=1e-3)


def test_ways_of_one_name_are_one_street(osm, line, read):
    tags = {"highway": "residential", "name": "Mill Lane"}
    (street,) = read(osm((line((0, 0), (100, 0)), tags), (line((100, 0), (100, 80)), tags))).streets
    assert (street.name, len(street.lines)) == ("Mill Lane", 2)
    np.testing.assert_allclose(street.lines[1].coords[1], [100, 80], atol=0.02)


def test_the_greater_street_comes_first_and_so_keeps_the_crossing(osm, line, read):
    lane, road = {"highway": "residential", "name": "A Lane"}, {"highway": "primary", "ref": "B 28"}
    path = osm((line((0, -50), (0, 50)), lane), (line((-50, 0), (50, 0)), road))
    assert [street.name for street in read(path).streets] == ["B 28", "A Lane"]


def test_ways_that_are_no_named_street_near_the_map_are_counted(osm, line, read):
    good = {"highway": "residential", "name": "Mill Lane"}
    path = osm(
        (line((0, 0), (100, 0)), good),
        (line((0, 9), (50, 9)), {"highway": "residential"}),
        (line((0, 9), (50, 9)), {"highway": "footway", "name": "Path"}),
        (line((0, 9), (50, 9)), {"building": "yes"}),
        ([(0.0, 0.0), (1.0, 1.0)], good),
        (line((0, 9)), good),
        (line((0, 0), (9, 0), (9, 9), (0, 0)), {"highway": "pedestrian", "name": "Market", "area": "yes"}),
    )
    found = read(path)
    assert ([street.name for street in found.streets], found.unnamed) == (["Mill Lane"], 1)
    assert len(found.dropped) == 5
    assert all(reason.startswith("1 ways ") for reason in found.dropped)


def test_a_file_without_named_ways_is_refused_with_the_reason(osm, line, read):
    with pytest.raises(DatasetError, match=r"map\.osm: no way with the tags highway and name.*1 ways have no name"):
        read(osm((line((0, 0), (9, 0)), {"highway": "residential"})))


@pytest.mark.parametrize(
    "text",
    [
        "",
        "no xml",
        "<osm version='0.6'><node id='1' lon=",
        "<gpx/>",
        "<osm version='0.6'><node id='1' version='1' lon='east' lat='48'/></osm>",
        '<!DOCTYPE a [<!ENTITY x "ha">]><osm version="0.6">&x;</osm>',
    ],
)
def test_a_file_that_is_no_openstreetmap_is_refused(tmp_path, read, text):
    (tmp_path / "map.osm").write_text(text)
    with pytest.raises(DatasetError, match=r"map\.osm"):
        read(tmp_path / "map.osm")


def test_a_missing_file_is_named(tmp_path, read):
    with pytest.raises(DatasetError, match=r"none\.osm: file not found; give an extract"):
        read(tmp_path / "none.osm")


def test_a_way_whose_nodes_are_not_in_the_file_is_counted(osm, line, read):
    tags = {"highway": "residential", "name": "Mill Lane"}
    path = osm((line((0, 0), (100, 0)), tags), (line((0, 50), (100, 50)), tags))
    text = path.read_text()
    path.write_text(text.replace(text[text.index('<node id="4"') : text.index("<way")], ""))
    found = read(path)
    assert (len(found.streets[0].lines), found.dropped) == (1, ("1 ways have fewer than two nodes in the file",))
