import json

import numpy as np
import pytest

from model_training.datasets.dataset import Dataset, DatasetDescription, scan_path, write_description, write_tum
from model_training.datasets.without_streets import WithoutStreets
from service.geometry.rigid import rotation_z, transform_from

#: Where the scans were taken: three in street 10, two in street 2, one between, two in the two sections of street 3, one in street 4.
XY = [(0, 0), (10, 0), (20, 0), (0, 100), (10, 100), (50, 50), (0, 200), (60, 200), (0, 300)]


def rectangle(street, x, y, *, section=None):
    """Return a street polygon, 10 m wide, from x[0] to x[1], centred at y."""
    (x0, x1), (y0, y1) = x, (y - 5, y + 5)
    ring = [[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]]
    properties = {
        "id": f"{street}{section or ''}",
        "street": street,
        "section": section,
        "name": street,
        "class_index": 0,
    }
    return {"type": "Feature", "properties": properties, "geometry": {"type": "Polygon", "coordinates": [ring]}}


@pytest.fixture
def folder(tmp_path):
    scan_path(tmp_path, 0).parent.mkdir(parents=True)
    for number in range(len(XY)):
        np.full((2, 4), number, np.float32).tofile(scan_path(tmp_path, number))
    poses = np.stack([transform_from(rotation_z(0.1 * k), np.array([*xy, 2.0])) for k, xy in enumerate(XY)])
    write_tum(tmp_path / "survey" / "poses.txt", np.arange(float(len(XY))), poses)
    features = [
        rectangle("3", (-10, 30), 200, section="beginning"),
        rectangle("3", (30, 90), 200, section="end"),
        rectangle("10", (-10, 90), 0),
        rectangle("2", (-10, 90), 100),
        rectangle("4", (-10, 90), 300),
    ]
    (tmp_path / "streets.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    write_description(tmp_path, DatasetDescription(name="town", source={"kind": "test"}, sensors={}))
    return tmp_path


def numbers_left(dataset):
    """Return the numbers of the remaining scans, by their content."""
    return [int(dataset.scan(k)[0, 0]) for k in range(len(dataset.survey_poses()))]


@pytest.mark.parametrize(
    ("options", "removed", "left"),
    [
        ({}, {"10", "4"}, [3, 4, 5, 6, 7]),  # streets by name: 10, 2, 3, 4
        ({"first": 1}, {"2"}, [0, 1, 2, 5, 6, 7, 8]),
        ({"first": 2}, {"3"}, [0, 1, 2, 3, 4, 5, 8]),  # with both its sections
        ({"each": 2}, {"10", "3"}, [3, 4, 5, 8]),
        ({"each": 1}, {"10", "2", "3", "4"}, [5]),  # what lies in no street stays
        ({"each": 9, "first": 8}, set(), list(range(9))),
    ],
)
def test_scans_of_the_streets_left_out_are_gone_and_the_others_keep_their_content(folder, options, removed, left):
    dataset = WithoutStreets(folder, **options)
    assert dataset.removed == removed
    assert numbers_left(dataset) == left


def test_every_scan_that_is_left_keeps_its_pose(folder):
    whole, dataset = Dataset(folder), WithoutStreets(folder)
    np.testing.assert_array_equal(dataset.survey_poses(), whole.survey_poses()[[3, 4, 5, 6, 7]])


def test_the_rest_of_the_dataset_is_the_folders(folder):
    dataset = WithoutStreets(folder)
    assert dataset.name == "town"
    streets = dataset.streets()
    assert streets is not None
    assert len(streets["features"]) == 5


def test_a_dataset_without_streets_is_left_whole(folder):
    (folder / "streets.geojson").unlink()
    dataset = WithoutStreets(folder)
    assert dataset.removed == set()
    assert numbers_left(dataset) == list(range(9))


@pytest.mark.parametrize(
    ("xy", "outside"),
    [((10, 0), True), ((0, 300), True), ((0, 100), False), ((50, 50), False), ((29, 200), False), ((31, 131), True),
     ((10, 129), False), ((10, 131), True), ((50, 21), False), ((50, 19), True)],
)  # fmt: skip
def test_outside_is_further_than_thirty_metres_from_every_scan_that_is_left(folder, xy, outside):
    """The removed street is outside. Its end, near a scan of another street, is not."""
    assert WithoutStreets(folder).is_outside(np.array([xy], np.float64)).tolist() == [outside]


def test_the_distance_limit_of_outside_is_an_argument_and_many_points_are_tested_at_once(folder):
    xy = np.array([(10.0, 105.0), (50.0, 55.0), (500.0, 500.0)])
    dataset = WithoutStreets(folder)
    assert dataset.is_outside(xy, away_m=4.9).tolist() == [True, True, True]
    assert dataset.is_outside(xy, away_m=5.1).tolist() == [False, False, True]
