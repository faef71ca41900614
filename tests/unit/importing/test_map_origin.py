import numpy as np
import pytest

from model_training.datasets.dataset import Dataset
from model_training.importing.map_origin import read_map_origin
from model_training.importing.take import TakeSettings, take
from service.errors import DatasetError


@pytest.mark.parametrize(
    ("text", "numbers", "heading_deg"),
    [
        ("48.98,8.44", [48.98, 8.44, 0.0], 0.0),
        ("-33.87, 151.21, 20", [-33.87, 151.21, 20.0], 0.0),
        ("48.98,8.44,110,-90", [48.98, 8.44, 110.0], -90.0),
    ],
)
def test_height_and_heading_may_be_omitted(text, numbers, heading_deg):
    found = read_map_origin(text)
    assert list(found.georeference().values()) == numbers
    assert found.heading_deg == heading_deg


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("48.98", r"'48.98' is not LAT,LON\[,HEIGHT\[,HEADING\]\] in degrees and metres, such as"),
        ("1,2,3,4,5", "is not LAT,LON"),
        ("north,8", "is not LAT,LON"),
        ("48,nan", "is not LAT,LON"),
        ("91,8", "latitude_deg: 91.0 is not between -90 and 90; give LAT,LON"),
        ("8,181", "longitude_deg: 181.0 is not between"),
        ("8,8,0,400", "the heading 400 is not between -360 and 360; give degrees counter-clockwise from east"),
    ],
)
def test_what_is_no_place_on_the_earth_is_refused_with_the_form(text, why):
    with pytest.raises(DatasetError, match=f"georeference: .*{why}") as error:
        read_map_origin(text)
    assert error.value.field == "georeference"


def test_poses_are_turned_until_x_points_east(straight):
    """The vehicle drives along x of its poses, which points north: 90 degrees counter-clockwise from east."""
    turned = read_map_origin("48.98,8.44,0,90").turned(straight(2.0))
    np.testing.assert_allclose(turned.T_map_vehicle[-1, :3, 3], [0, 2, 0], atol=1e-12)
    np.testing.assert_allclose(turned.T_map_vehicle[-1, :3, 0], [0, 1, 0], atol=1e-12)  # ahead is north
    assert turned.name == "straight on, turned by 90 degrees"
    same = straight(2.0)
    assert read_map_origin("48.98,8.44").turned(same) is same


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        (TakeSettings(), {"latitude_deg": 1.0}),
        (TakeSettings(own_frame=False), None),
        (TakeSettings(georeference={"latitude_deg": 2.0}), {"latitude_deg": 2.0}),
        (TakeSettings(georeference={"latitude_deg": 2.0}, own_frame=False), {"latitude_deg": 2.0}),
    ],
)
def test_the_dataset_has_the_georeference_of_its_trajectory(
    recording_of, scan_at, straight, tmp_path, settings, expected
):
    recording = recording_of([scan_at(1.0)], georeference={"latitude_deg": 1.0})
    take(recording, straight(2.0), tmp_path / "out", settings)
    assert Dataset(tmp_path / "out").description.georeference == expected
