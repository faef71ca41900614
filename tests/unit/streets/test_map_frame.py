from typing import Any

import numpy as np
import pyproj.network
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from model_training.streets.map_frame import MapFrame
from service.errors import DatasetError
from service.geometry.earth import Georeference

COORDINATE = st.floats(-5000, 5000)


@settings(max_examples=50, deadline=None)
@given(COORDINATE, COORDINATE, st.floats(-85, 85), st.floats(-179, 179), st.floats(-400, 4000))
def test_wgs84_comes_back_within_a_centimetre(x, y, latitude, longitude, height):
    place = {"latitude_deg": latitude, "longitude_deg": longitude, "height_m": height}
    # A point at the origin's height above the ellipsoid, not on the plane: the Earth falls away from under it.
    z = -(x**2 + y**2) / (2 * 6.371e6)
    there = Georeference(**place).to_earth(np.array([x, y, z]))
    back = MapFrame(place).from_wgs84(np.array([[there[1], there[0]]]))
    np.testing.assert_allclose(back, [[x, y]], atol=0.01)


def test_places_beyond_the_map_have_no_coordinates(ulm):
    places = np.array([[9.99, 48.4], [9.99, 52.0], [9.99 - 180, -48.4], [9.99, 99.0], [np.nan, 0.0]])
    assert np.isfinite(MapFrame(ulm).from_wgs84(places)).all(axis=1).tolist() == [True, False, False, False, False]


def test_a_projection_agrees_with_the_places_it_projects(ulm):
    utm = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:25832", always_xy=True)
    place = np.array([[9.995, 48.402]])
    eastings = np.column_stack(utm.transform(*place.T))
    frame = MapFrame(ulm)
    np.testing.assert_allclose(frame.from_projection(eastings, "EPSG:25832"), frame.from_wgs84(place), atol=1e-3)


def test_the_network_stays_off(ulm):
    network: Any = pyproj.network  # its stub exports nothing
    network.set_network_enabled(active=True)
    MapFrame(ulm)
    assert not network.is_network_enabled()


@pytest.mark.parametrize("wrong", [{"latitude_deg": 99.0, "longitude_deg": 0.0}, {"latitude_deg": 1.0}])
def test_a_georeference_that_is_no_place_is_refused(wrong):
    with pytest.raises(DatasetError, match=r"dataset\.json: georeference"):
        MapFrame(wrong)
