import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.geometry.earth import Georeference

EQUATOR = 6_378_137.0  # radius, m
POLE = 6_356_752.3142  # semi-minor axis, m

latitudes = st.one_of(
    st.floats(-90, 90), st.sampled_from([-90.0, 90.0, 0.0]), st.floats(89.99, 90), st.floats(-1e-3, 1e-3)
)
longitudes = st.one_of(st.floats(-180, 180), st.sampled_from([-180.0, 180.0, 0.0]), st.floats(179.999, 180))
heights = st.floats(-500, 9000)
origins = st.builds(Georeference, latitudes, longitudes, heights)
positions = st.tuples(st.floats(-3e4, 3e4), st.floats(-3e4, 3e4), st.floats(-500, 2000)).map(np.array)


def turned_deg(one, other):
    """Return the difference of two longitudes, the shorter way round, degrees."""
    return (other - one + 180) % 360 - 180


@pytest.mark.parametrize(
    ("latitude_deg", "of_latitude_m", "of_longitude_m"),
    [(0, 110_574, 111_320), (15, 110_649, 107_550), (30, 110_852, 96_486), (45, 111_132, 78_847), (-60, 111_412, 55_800),
     (75, 111_618, 28_902)],
)  # fmt: skip
@pytest.mark.parametrize("longitude_deg", [0.0, 13.4, -180.0])
def test_a_degree_is_as_long_as_the_tables_say(latitude_deg, of_latitude_m, of_longitude_m, longitude_deg):
    """Lengths of a degree on WGS-84, metres, measured over a hundredth of a degree."""
    latitude_deg = float(latitude_deg)
    earth = Georeference(latitude_deg, longitude_deg)
    ends = [earth.to_map(latitude_deg + half, longitude_deg, 0.0) for half in (-0.005, 0.005)]
    np.testing.assert_allclose(100 * (ends[1] - ends[0]), [0, of_latitude_m, 0], atol=2.0)
    ends = [earth.to_map(latitude_deg, longitude_deg + half, 0.0) for half in (-0.005, 0.005)]
    np.testing.assert_allclose(100 * (ends[1] - ends[0]), [of_longitude_m, 0, 0], atol=2.0)


@pytest.mark.parametrize(
    ("origin", "place", "expected"),
    [
        ((0, 0), (90, 0, 0), (0, POLE, -EQUATOR)),
        ((0, 0), (-90, 77, 0), (0, -POLE, -EQUATOR)),
        ((0, 0), (0, 90, 0), (EQUATOR, 0, -EQUATOR)),
        ((0, 0), (0, -90, 1000), (-EQUATOR - 1000, 0, -EQUATOR)),
        ((0, 90), (0, -90, 0), (0, 0, -2 * EQUATOR)),
        ((90, 0), (0, 90, 0), (EQUATOR, 0, -POLE)),  # at the pole, x goes to where longitude 90 comes up
        ((90, 0), (0, 180, 0), (0, EQUATOR, -POLE)),
        ((0, 180), (0, -180, 0), (0, 0, 0)),
        ((0, 0, 100), (0, 0, 350), (0, 0, 250)),
        ((90, 0, -20), (90, 123, 10), (0, 0, 30)),
    ],
)
def test_the_earths_axes_are_where_they_are(origin, place, expected):
    found = Georeference(*(float(x) for x in origin)).to_map(*(float(x) for x in place))
    np.testing.assert_allclose(found, expected, atol=1e-3)


def test_points_north_of_or_above_the_origin_have_the_same_longitude():
    earth = Georeference(52.52, 13.405, 34.0)
    latitude, longitude, height = earth.to_earth(np.array([0.0, 1000.0, 0.0]))
    assert longitude == pytest.approx(13.405, abs=1e-9)
    assert latitude == pytest.approx(52.52 + 1000 / 111_270, abs=1e-6)  # a degree is 111,270 m long there
    assert height == pytest.approx(34.0 + 1000**2 / (2 * 6.376e6), abs=1e-3)  # the level plane leaves the round Earth
    np.testing.assert_allclose(earth.to_earth(np.array([0.0, 0.0, 1000.0])), [52.52, 13.405, 1034.0], atol=1e-9)


@pytest.mark.parametrize("x", [1000.0, -1000.0])
def test_east_goes_on_beyond_the_date_line(x):
    """A kilometre is 0.008983 degrees on the equator."""
    found = Georeference(0.0, 180.0).to_earth(np.array([x, 0.0, 0.0]))
    assert turned_deg(180.0, found[1]) == pytest.approx(np.sign(x) * 0.0089832, abs=1e-6)
    assert -180 <= found[1] <= 180
    assert found[0] == pytest.approx(0.0, abs=1e-9)


def test_beyond_the_pole_one_comes_down_on_the_other_side():
    earth = Georeference(90.0, 30.0)
    for northing, longitude_deg in ((-1000.0, 30.0), (1000.0, -150.0)):
        latitude, longitude, _ = earth.to_earth(np.array([0.0, northing, 0.0]))
        assert latitude == pytest.approx(90 - 1000 / 111_694, abs=1e-7)
        assert turned_deg(longitude_deg, longitude) == pytest.approx(0.0, abs=1e-6)


@given(origins, positions)
def test_there_and_back_again_in_metres(earth, position_m):
    np.testing.assert_allclose(earth.to_map(*earth.to_earth(position_m)), position_m, atol=1e-6)


@given(origins, latitudes, longitudes, heights)
def test_there_and_back_again_in_degrees(earth, latitude_deg, longitude_deg, height_m):
    """Holds at any distance from the origin. At the pole every longitude is right."""
    found = earth.to_earth(earth.to_map(latitude_deg, longitude_deg, height_m))
    assert found[0] == pytest.approx(latitude_deg, abs=1e-8)
    assert found[2] == pytest.approx(height_m, abs=1e-4)
    assert turned_deg(longitude_deg, found[1]) * np.cos(np.deg2rad(latitude_deg)) == pytest.approx(0, abs=1e-8)


@given(origins)
def test_the_origin_is_the_origin(earth):
    np.testing.assert_allclose(
        earth.to_map(earth.latitude_deg, earth.longitude_deg, earth.height_m), np.zeros(3), atol=1e-9
    )
    found = earth.to_earth(np.zeros(3))
    assert (found[0], found[2]) == pytest.approx((earth.latitude_deg, earth.height_m), abs=1e-6)


@given(origins, positions, positions)
def test_distances_are_those_of_the_earth_whatever_the_origin(earth, one, other):
    """With another origin, the distance of the same two places is the same."""
    elsewhere = Georeference(-33.0, 151.0, 5.0)
    seen = [elsewhere.to_map(*earth.to_earth(position)) for position in (one, other)]
    assert np.linalg.norm(seen[1] - seen[0]) == pytest.approx(np.linalg.norm(other - one), abs=1e-5)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ((90.0001, 0.0, 0.0), "latitude_deg: 90.0001 is not between -90 and 90"),
        ((-91.0, 0.0, 0.0), "latitude_deg: -91.0 is not between -90 and 90"),
        ((np.nan, 0.0, 0.0), "latitude_deg: nan is not between -90 and 90"),
        ((0.0, 180.5, 0.0), "longitude_deg: 180.5 is not between -180 and 180"),
        ((0.0, -np.inf, 0.0), "longitude_deg: -inf is not between -180 and 180"),
        ((0.0, 0.0, 1.1e5), "height_m: 110000.0 is not between -100000 and 100000"),
        ((0.0, 0.0, np.nan), "height_m: nan is not between -100000 and 100000"),
    ],
)
def test_an_invalid_place_is_refused_by_name(given, message):
    with pytest.raises(ValueError, match="is not between") as error:
        Georeference(*(float(x) for x in given))
    assert str(error.value) == message


def test_the_ends_of_the_ranges_are_places():
    for latitude_deg in (-90.0, 90.0):
        for longitude_deg in (-180.0, 180.0):
            assert np.isfinite(Georeference(latitude_deg, longitude_deg).to_map(0.0, 0.0, 0.0)).all()


@given(origins, st.lists(positions, min_size=1, max_size=5))
def test_many_positions_are_converted_as_one_by_one(origin, places):
    found = origin.to_earth_all(np.stack(places))
    np.testing.assert_allclose(found, [origin.to_earth(place) for place in places], rtol=0, atol=1e-7)
    np.testing.assert_array_equal(origin.to_earth_all(np.stack(places)[None]), found[None])
