"""A dataset that is moved into another map frame on the Earth."""

import json
import shutil
from dataclasses import asdict

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from model_training.datasets.dataset import Dataset
from model_training.datasets.frames import MovedFrame, global_frame
from model_training.datasets.survey_part import SurveyPart
from service.errors import DatasetError
from service.geometry.earth import Georeference

ULM = Georeference(48.4, 9.98, 478.0)
LATITUDES, LONGITUDES = st.floats(-89.0, 89.0), st.floats(-180.0, 180.0)


@pytest.fixture
def on_earth(small_dataset, tmp_path):
    """Return a dataset whose map frame has its origin in Ulm."""
    folder = shutil.copytree(small_dataset.folder, tmp_path / "on_earth")
    description = json.loads((folder / "dataset.json").read_text())
    (folder / "dataset.json").write_text(json.dumps(description | {"georeference": asdict(ULM)}))
    return Dataset(folder)


def test_an_origin_100_m_higher_lowers_everything_by_100_m():
    T = ULM.T_to(Georeference(48.4, 9.98, 578.0))
    np.testing.assert_allclose(T, [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, -100], [0, 0, 0, 1]], atol=1e-8)


def test_an_origin_a_quarter_of_the_earth_away():
    """A quarter of the Earth to the east, east becomes up, and up becomes west. The radius is 6,378,137 m."""
    T = Georeference(0.0, 0.0).T_to(Georeference(0.0, 90.0))
    radius = 6_378_137.0
    expected = np.array([[0, 0, -1, -radius], [0, 1, 0, 0], [1, 0, 0, -radius], [0, 0, 0, 1]])
    np.testing.assert_allclose(T, expected, rtol=1e-15, atol=1e-8)


@given(LATITUDES, LONGITUDES, st.floats(-0.5, 0.5), st.floats(-0.5, 0.5))
def test_a_moved_position_is_the_same_place_on_the_earth(latitude, longitude, north, east):
    here = Georeference(latitude, longitude, 100.0)
    there = Georeference(float(np.clip(latitude + north, -90, 90)), float(np.clip(longitude + east, -180, 180)), 300.0)
    position = np.array([120.0, -40.0, 3.0])
    moved = here.T_to(there) @ [*position, 1.0]
    np.testing.assert_allclose(there.to_map(*here.to_earth(position)), moved[:3], atol=1e-6)


def test_surveys_of_one_town_have_one_global_frame():
    """Origins lie at every tenth of a degree, on the ellipsoid."""
    expected = Georeference(48.4, 10.0, 0.0)
    assert global_frame(ULM, np.zeros((3, 3))) == expected
    assert global_frame(Georeference(48.42, 9.96, 12.0), np.zeros((1, 3))) == expected
    # The middle of the survey decides, not the origin of its poses: 4 km north of 48.44 degrees are 48.476 degrees.
    north = np.array([[0.0, 3000.0, 0.0], [0.0, 5000.0, 0.0]])
    assert global_frame(Georeference(48.44, 9.98, 0.0), north).latitude_deg == 48.5


def test_the_meridian_opposite_greenwich_has_one_global_frame():
    of_both = {global_frame(Georeference(10.0, each), np.zeros((1, 3))) for each in (179.97, 180.0, -179.98, -180.0)}
    assert of_both == {Georeference(10.0, -180.0, 0.0)}


@given(LATITUDES, LONGITUDES)
def test_the_origin_of_a_global_frame_is_at_most_8_km_away(latitude, longitude):
    here = Georeference(latitude, longitude)
    origin = global_frame(here, np.zeros((1, 3)))
    assert np.linalg.norm(here.T_to(origin)[:2, 3]) < 8_000
    assert global_frame(origin, np.zeros((1, 3))) == origin


def test_poses_truth_and_streets_move_together(on_earth):
    there = {"latitude_deg": 48.4, "longitude_deg": 9.98, "height_m": 470.0}
    moved = on_earth.in_frame(there)
    assert moved.description.georeference == there
    assert on_earth.description.georeference == asdict(ULM)
    up = np.array([[0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 8.0], [0, 0, 0, 0]])  # the new origin is 8 m lower
    np.testing.assert_allclose(moved.survey_poses(), on_earth.survey_poses() + up, atol=1e-8)
    name = on_earth.query_sets(with_truth=True)[0]
    for here, other in zip(on_earth.queries(name), moved.queries(name), strict=True):
        np.testing.assert_allclose(other.T_map_camera, here.T_map_camera + up, atol=1e-8)
    own, streets = on_earth.streets(), moved.streets()
    assert [each["properties"] for each in streets["features"]] == [each["properties"] for each in own["features"]]
    corners = [np.array(each["features"][0]["geometry"]["coordinates"][0]) for each in (own, streets)]
    np.testing.assert_allclose(corners[1], corners[0], atol=1e-8)


def test_streets_lie_at_the_height_of_the_survey():
    """Seen from an origin a degree further east on the equator, up leans by a degree to the west."""
    frame = MovedFrame(Georeference(0.0, 1.0), Georeference(0.0, 0.0), ground_m=500.0)
    street = {
        "features": [
            {"properties": {}, "geometry": {"type": "LineString", "coordinates": [[0.0, 7.0, 1.0], [0.0, 9.0, 1.0]]}}
        ]
    }
    (x, y), _ = frame.streets(street)["features"][0]["geometry"]["coordinates"]
    assert x == pytest.approx((6_378_137.0 + 500.0) * np.sin(np.deg2rad(1.0)), abs=1e-4)
    assert y == pytest.approx(7.0)


def test_a_moved_dataset_can_be_moved_again(on_earth):
    once = on_earth.in_frame(asdict(Georeference(48.5, 9.9, 0.0)))
    back = once.in_frame(asdict(ULM))
    np.testing.assert_allclose(back.survey_poses(), on_earth.survey_poses(), atol=1e-8)


def test_a_part_has_the_frame_of_the_survey(on_earth):
    moved = on_earth.in_frame(asdict(Georeference(48.5, 9.9, 0.0)))
    numbers, poses = np.array([0, 2]), moved.survey_poses()[[0, 2]]
    part = SurveyPart(moved.folder, numbers, poses).moved(moved.frame)
    assert part.description == moved.description
    assert part.streets() == moved.streets()
    np.testing.assert_array_equal(part.survey_trajectory()[1], poses)


@pytest.mark.parametrize("georeference", [None, asdict(ULM)])
def test_an_equal_or_an_unknown_frame_moves_nothing(on_earth, georeference):
    assert on_earth.in_frame(georeference) is on_earth


def test_a_dataset_without_a_place_on_the_earth_is_not_moved(small_dataset):
    assert small_dataset.in_frame(asdict(ULM)) is small_dataset


@pytest.mark.parametrize("wrong", [{"latitude_deg": 91.0, "longitude_deg": 0.0}, {"latitude_deg": 1.0}])
def test_a_frame_that_is_no_place_is_refused(on_earth, wrong):
    with pytest.raises(DatasetError, match="the map: georeference: ") as refused:
        on_earth.in_frame(wrong)
    assert refused.value.field == "georeference"


@pytest.mark.parametrize(("latitude_deg", "is_near"), [(49.29, True), (49.31, False)])
def test_a_survey_far_from_the_origin_of_a_frame_is_refused(on_earth, latitude_deg, is_near):
    """A degree of latitude is 111.2 km here. So 0.89 degrees are 99 km, and 0.91 degrees are 101 km."""
    there = asdict(Georeference(latitude_deg, 9.98, 478.0))
    if is_near:
        assert on_earth.in_frame(there).description.georeference == there
        return
    for dataset in (on_earth, on_earth.in_frame(asdict(Georeference(48.5, 9.98)))):
        with pytest.raises(
            DatasetError, match=r"the dataset lies 101 km from the origin of the map, .* check georeference"
        ) as refused:
            dataset.in_frame(there)
        assert refused.value.field == "georeference"


def test_queries_without_a_survey_count_by_the_origin_of_their_frame(on_earth):
    (on_earth.folder / "survey" / "poses.txt").unlink()
    assert on_earth.in_frame(asdict(Georeference(48.5, 9.98))).frame is not None
    with pytest.raises(DatasetError, match=r"the dataset lies 6,\d{3} km from the origin of the map"):
        on_earth.in_frame(asdict(Georeference(40.7, -74.0)))


@pytest.mark.parametrize(
    "feature",
    [{"properties": {}}, {"geometry": None}, {"geometry": {"type": "Polygon", "coordinates": [[["east", 2.0]]]}}],
)
def test_a_street_that_cannot_be_moved_is_named(feature):
    frame = MovedFrame(ULM, Georeference(48.5, 9.9))
    with pytest.raises(DatasetError, match=r"streets\.geojson: a feature has no geometry .* `streetfix streets`"):
        frame.streets({"features": [feature]})
