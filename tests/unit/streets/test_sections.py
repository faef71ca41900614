import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from model_training.streets.axis import axis_of
from model_training.streets.corridor import corridor
from model_training.streets.named_street import NamedStreet
from model_training.streets.sections import in_sections
from service.errors import DatasetError


def street_of(*lines, name="High Street", width=8.0, **more):
    drawn = tuple(shapely.LineString(line) for line in lines)
    return NamedStreet(name, name, corridor(drawn, [width] * len(drawn)), drawn, **more)


def same(surface, expected):
    return surface.symmetric_difference(expected).area < 0.01


def test_ends_have_the_requested_length_and_the_rest_is_between():
    begin, rest, end = in_sections([street_of([(0, 0), (100, 0)])], length_m=30)
    assert same(begin.surface, shapely.box(0, -4, 30, 4))
    assert same(rest.surface, shapely.box(30, -4, 70, 4))
    assert same(end.surface, shapely.box(70, -4, 100, 4))
    assert [(s.name, s.section) for s in (begin, rest, end)] == [
        ("Beginning of High Street", "beginning"),
        ("High Street", None),
        ("End of High Street", "end"),
    ]


def test_a_street_of_less_than_two_lengths_is_halved():
    begin, end = in_sections([street_of([(0, 0), (100, 0)])], length_m=60)
    assert same(begin.surface, shapely.box(0, -4, 50, 4))
    assert same(end.surface, shapely.box(50, -4, 100, 4))


def test_numbered_sections_are_equal_and_no_longer_than_asked():
    cut = in_sections([street_of([(0, 0), (100, 0)], id="hs")], length_m=30, cut="numbered")
    assert [section.surface.area for section in cut] == pytest.approx([200] * 4)
    assert [section.name for section in cut][:2] == ["High Street, section 1", "High Street, section 2"]
    assert [section.id for section in cut] == ["hs-1", "hs-2", "hs-3", "hs-4"]
    assert {section.street for section in cut} == {"High Street"}


@pytest.mark.parametrize(
    "street", [street_of([(0, 0), (30, 0)]), street_of([(0, 0), (100, 0)], divisible=False)], ids=["short", "junction"]
)
def test_a_short_street_and_a_junction_stay_whole(street):
    assert in_sections([street], length_m=30) == (street,)


def test_more_sections_than_make_sense_are_refused():
    with pytest.raises(DatasetError, match="High Street is 100000 m long"):
        in_sections([street_of([(0, 0), (1e5, 0)])], length_m=30, cut="numbered")


def test_the_beginning_is_where_the_source_begins():
    begin, _ = in_sections([street_of([(100, 0), (0, 0)])], length_m=60)
    assert begin.surface.contains(shapely.Point(99, 0))


@settings(max_examples=30, deadline=None)
@given(
    st.lists(st.tuples(st.integers(-200, 200), st.integers(-200, 200)), min_size=2, max_size=6, unique=True),
    st.floats(5, 120),
    st.sampled_from(["ends", "numbered"]),
)
def test_sections_cover_their_street_and_nothing_twice(points, length_m, cut):
    street = street_of(points)
    sections = in_sections([street], length_m=length_m, cut=cut)
    union = shapely.union_all([section.surface for section in sections])
    assert union.symmetric_difference(street.surface).area < 1e-3
    assert sum(section.surface.area for section in sections) == pytest.approx(union.area, abs=1e-3)


def test_a_polygon_is_cut_along_its_longer_side_from_west_to_east():
    begin, end = in_sections([NamedStreet("a", "a", shapely.box(0, 0, 100, 10))], length_m=60)
    assert same(begin.surface, shapely.box(0, 0, 50, 10))
    assert same(end.surface, shapely.box(50, 0, 100, 10))


def axis(*lines):
    return np.array(axis_of(shapely.Polygon(), [shapely.LineString(line) for line in lines]).coords)


def test_the_axis_follows_pieces_whatever_their_order_and_direction():
    np.testing.assert_allclose(axis([(50, 0), (90, 0)], [(50, 0), (0, 0)]), [[0, 0], [50, 0], [90, 0]])


def test_the_axis_bridges_a_junction():
    np.testing.assert_allclose(axis([(0, 0), (50, 0)], [(70, 0), (120, 0)]), [[0, 0], [50, 0], [70, 0], [120, 0]])


def test_the_axis_leaves_a_branch_out():
    found = axis([(0, 0), (50, 0)], [(50, 0), (120, 0)], [(50, 0), (50, 20)])
    np.testing.assert_allclose(found, [[0, 0], [50, 0], [120, 0]])


def test_two_carriageways_have_the_axis_of_one():
    found = axis([(0, 0), (60, 0)], [(60, 0), (100, 0)], [(100, 12), (55, 12)], [(55, 12), (0, 12)])
    assert shapely.LineString(found).length < 125  # there, and not back


def test_a_ring_is_its_own_axis():
    assert shapely.LineString(axis([(0, 0), (9, 0), (9, 9), (0, 0)])).is_ring
