import json
import shutil
from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree

from model_training.datasets.dataset import Dataset
from model_training.mapping import work
from model_training.mapping.area import CELL_M, covered_by, polygon_of
from model_training.mapping.stages import ResumedStages
from model_training.mapping.stored_map import voxels_of
from model_training.mapping.update import update_map
from model_training.mapping.verify import damage_of
from model_training.mapping.work import work_folder
from service.errors import BundleError, DatasetError
from service.localization.localizer import Localizer
from service.maps.reader import MapBundle
from service.retrieval.query import Query


def positions(bundle):
    return bundle.cloud.unpacked(np.s_[:])["xyz"] + bundle.cloud.origin_m


@pytest.fixture(scope="module")
def whole(small_map):
    return MapBundle.open(small_map)


@pytest.fixture(scope="module")
def extended(half_maps, halves, tmp_path_factory):
    out = tmp_path_factory.mktemp("extended") / "m"
    update_map(half_maps[0], halves[1], out, threads=1)
    return MapBundle.open(out)


def test_a_map_extended_by_the_second_half_is_the_map_of_the_whole(extended, whole):
    assert damage_of(extended.path) == []
    np.testing.assert_allclose(extended.T_map_place[:, :2, 3], whole.T_map_place[:, :2, 3], atol=1e-9)
    views = np.arange(len(whole.views))
    np.testing.assert_allclose(extended.view_index.vectors(views), whole.view_index.vectors(views), atol=1e-6)
    tree: Any = cKDTree(positions(whole))
    distance, _ = tree.query(positions(extended))
    assert len(positions(extended)) == len(positions(whole))
    assert distance.max() < 1e-3  # half a step in each map


def test_it_answers_like_the_map_built_at_once(extended, whole, small_dataset):
    frames = list(small_dataset.queries("drive1_precise"))[:3]
    for frame in frames:
        one, other = (
            Localizer.open(bundle).localize(
                Query(rgb=frame.rgb(), depth_m=frame.depth_m(), camera=frame.camera.pinhole())
            )
            for bundle in (extended, whole)
        )
        apart_m = np.linalg.norm(one.T_map_camera_guess[:3, 3] - other.T_map_camera_guess[:3, 3])
        assert apart_m < 0.03  # the adjustment ends at a step below 2 cm


def test_the_same_drive_again_adds_no_place(small_map, small_dataset, tmp_path):
    update_map(small_map, small_dataset, tmp_path / "m", threads=1)
    again, once = MapBundle.open(tmp_path / "m"), MapBundle.open(small_map)
    np.testing.assert_allclose(again.T_map_place, once.T_map_place, atol=1e-12)
    one, other = (voxels_of(bundle).statistics()["cell"] for bundle in (again, once))
    np.testing.assert_array_equal(one, other)


@pytest.fixture(scope="module")
def block(whole):
    """Return points of the demolished block: everything higher than 1 m in the middle 15 m of the street."""
    track = whole.T_map_place[:, :3, 3]
    along = int(np.ptp(track[:, 1]) > np.ptp(track[:, 0]))
    middle = float(track[:, along].mean())
    ground = float(track[:, 2].mean()) - whole.manifest.lidar_height_m

    def standing(points):
        return (np.abs(points[:, along] - middle) < 7.5) & (points[:, 2] > ground + 1.0)

    return standing


@pytest.fixture(scope="module")
def rebuilt(small_map, small_dataset, part_of, block, tmp_path_factory):
    new = part_of(range(len(small_dataset.survey_poses())), block)
    out = tmp_path_factory.mktemp("rebuilt")
    update_map(small_map, new, out / "added", threads=1)
    update_map(small_map, new, out / "replaced", replace_covered=True, threads=1)
    return MapBundle.open(out / "added"), MapBundle.open(out / "replaced")


def near_track(bundle, points, reach_m=8.0):
    return cKDTree(bundle.T_map_place[:, :2, 3]).query(points[:, :2])[0] < reach_m


def test_a_demolished_block_stays_without_replacement(rebuilt, whole, block):
    before = positions(whole)
    standing = int((block(before) & near_track(whole, before)).sum())
    left = [int((block(positions(b)) & near_track(b, positions(b))).sum()) for b in rebuilt]
    assert standing > 100
    assert left[0] > 0.8 * standing  # voxels at the cut sink below it
    assert left[1] < 0.1 * standing


def test_replaced_places_are_those_of_the_new_drive(rebuilt, whole):
    added, replaced = rebuilt
    assert damage_of(replaced.path) == []
    np.testing.assert_allclose(replaced.T_map_place[:, :2, 3], whole.T_map_place[:, :2, 3], atol=0.2)
    views = np.arange(len(whole.views))
    np.testing.assert_allclose(added.view_index.vectors(views), whole.view_index.vectors(views), atol=1e-6)
    assert np.abs(replaced.view_index.vectors(views) - whole.view_index.vectors(views)).max() > 0.01


def test_elsewhere_the_map_stays_as_it_was(rebuilt, whole, block):
    """The update replaces only the part that the new survey covers. That survey measured everything except the block."""
    before = positions(whole)
    others = before[~block(before)]
    assert np.mean(cKDTree(positions(rebuilt[1])).query(others)[0] < 0.3) > 0.97


def square(path, low, high):
    ring = [[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]], [low[0], low[1]]]
    path.write_text(json.dumps({"type": "Polygon", "coordinates": [[[float(x) for x in xy] for xy in ring]]}))
    return path


def test_a_polygon_is_replaced_and_nothing_else(small_map, whole, small_dataset, part_of, block, tmp_path):
    centre = whole.T_map_place[4, :2, 3]
    area = square(tmp_path / "area.geojson", centre - 6, centre + 6)
    new = part_of(range(len(small_dataset.survey_poses())), block)
    update_map(small_map, new, tmp_path / "m", replace_area=area, threads=1)
    found = MapBundle.open(tmp_path / "m")
    inside = polygon_of(area)
    assert found.manifest.counts.places == whole.manifest.counts.places
    demolished = block(positions(found)) & inside(positions(found)[:, :2])
    was = block(positions(whole)) & inside(positions(whole)[:, :2])
    assert demolished.sum() < 0.1 * max(1, was.sum()) or was.sum() == 0
    apart = positions(whole)[~inside(positions(whole)[:, :2])]
    assert np.mean(cKDTree(positions(found)).query(apart)[0] < 0.1) > 0.97
    # Old places outside keep their order before the new ones.
    kept = whole.T_map_place[~inside(whole.T_map_place[:, :2, 3])]
    np.testing.assert_allclose(found.T_map_place[: len(kept), :2, 3], kept[:, :2, 3], atol=1e-9)


def test_a_polygon_far_from_the_drive_is_refused(small_map, small_dataset, tmp_path):
    area = square(tmp_path / "far.geojson", np.array([9000.0, 9000.0]), np.array([9100.0, 9100.0]))
    with pytest.raises(DatasetError, match="no place of the new survey lies in the polygon"):
        update_map(small_map, small_dataset, tmp_path / "m", replace_area=area, threads=1)
    assert not (tmp_path / "m").exists()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "is not valid JSON"),
        ("[]", "not a valid geometry"),
        ('{"type": "Point", "coordinates": [1, 2]}', "contains Point, not a polygon"),
        ('{"type": "FeatureCollection", "features": []}', "contains nothing, not a polygon"),
        ('{"type": "Polygon", "coordinates": [[[0, 0], [1, 1], [1, 0], [0, 1], [0, 0]]]}', "crosses itself"),
        ('{"type": "Polygon", "coordinates": [[[0, 0], [1]]]}', "not a valid geometry"),
    ],
)
def test_an_invalid_polygon_is_refused(tmp_path, text, message):
    (tmp_path / "area.geojson").write_text(text)
    with pytest.raises(DatasetError, match=message):
        polygon_of(tmp_path / "area.geojson")


def test_a_missing_polygon_is_named(tmp_path):
    with pytest.raises(DatasetError, match=r"none\.geojson cannot be read"):
        polygon_of(tmp_path / "none.geojson")


def test_polygons_come_alone_or_as_features(tmp_path):
    polygon = {"type": "Polygon", "coordinates": [[[0, 0], [2, 0], [2, 2], [0, 2], [0, 0]]]}
    feature = {"type": "Feature", "properties": {}, "geometry": polygon}
    asked = np.array([[1.0, 1.0], [3.0, 1.0], [2.0, 1.0]])
    for document in (polygon, feature, {"type": "FeatureCollection", "features": [feature]}):
        (tmp_path / "area.geojson").write_text(json.dumps(document))
        assert polygon_of(tmp_path / "area.geojson")(asked).tolist() == [True, False, True]


def test_covered_is_where_something_was_measured_near_the_track():
    """Covered are the cells of measured points beside a place, and gaps of one cell. Beyond 25 m nothing is covered."""
    x = np.array([11.0, 13.0, 17.0, 41.0])
    inside = covered_by(np.c_[x, np.full(4, 9.0)], np.array([[0.0, 1.0]]))
    asked = np.array([[11.5, 9.5], [15.0, 9.0], [17.0, 9.0], [41.0, 9.0], [11.0, 30.0], [-900.0, 9.0], [3.0, 1.0]])
    assert CELL_M == 2.0
    assert inside(asked).tolist() == [True, True, True, False, False, False, True]


def test_a_drive_in_another_frame_is_refused(small_map, small_dataset, tmp_path):
    folder = shutil.copytree(small_dataset.folder, tmp_path / "elsewhere")
    description = json.loads((folder / "dataset.json").read_text())
    description["georeference"] = {"latitude_deg": 52.5, "longitude_deg": 13.4, "height_m": 30.0}
    (folder / "dataset.json").write_text(json.dumps(description))
    with pytest.raises(
        DatasetError, match=r"the georeference of the dataset is .*52\.5.* that of the map .* is missing"
    ) as refused:
        update_map(small_map, Dataset(folder), tmp_path / "m", threads=1)
    assert refused.value.field == "georeference"


def test_an_empty_drive_is_refused(small_map, part_of, tmp_path):
    with pytest.raises(DatasetError, match=r"poses\.txt is empty"):
        update_map(small_map, part_of([]), tmp_path / "m", threads=1)


def test_a_lidar_that_sees_other_rows_is_refused(small_map, small_dataset, part_of, whole, tmp_path):
    ground = float(whole.T_map_place[:, 2, 3].mean()) - whole.manifest.lidar_height_m
    low = part_of(range(len(small_dataset.survey_poses())), lambda points: points[:, 2] > ground + 0.5)
    far = part_of(low.numbers, lambda p: low.demolished(p) | (np.linalg.norm(p - p.mean(axis=0), axis=1) > 8))
    with pytest.raises(DatasetError, match="the LiDAR of the survey does not see"):
        update_map(small_map, far, tmp_path / "m", threads=1)


def test_a_name_that_is_taken_is_refused(small_map, small_dataset, tmp_path):
    with pytest.raises(BundleError, match="already"):
        update_map(small_map, small_dataset, tmp_path, threads=1)


def test_a_folder_that_is_no_bundle_is_refused(small_dataset, tmp_path):
    with pytest.raises(BundleError, match=r"not a map bundle: manifest\.json is missing"):
        update_map(tmp_path, small_dataset, tmp_path / "m", threads=1)


def test_a_street_that_contradicts_the_maps_is_refused_before_the_work(small_map, small_dataset, tmp_path):
    folder = shutil.copytree(small_dataset.folder, tmp_path / "renamed")
    streets = json.loads((folder / "streets.geojson").read_text())
    streets["features"][0]["properties"]["name"] = "Another street"
    (folder / "streets.geojson").write_text(json.dumps(streets))
    told = []
    with pytest.raises(BundleError, match="both maps have a street"):
        update_map(small_map, Dataset(folder), tmp_path / "m", threads=1, report=lambda *event: told.append(event))
    assert told == []


def test_a_killed_update_goes_on_to_the_same_version(half_maps, halves, extended, tmp_path, monkeypatch):
    monkeypatch.setattr(work, "CHUNK", 2)

    def report(_stage, done, _total):
        if done == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        update_map(half_maps[0], halves[1], tmp_path / "m", threads=1, report=report)
    assert not (tmp_path / "m").exists()
    assert list(work_folder(tmp_path / "m").glob("places-*"))
    made = update_map(half_maps[0], halves[1], tmp_path / "m", threads=1)
    np.testing.assert_allclose(positions(MapBundle.open(tmp_path / "m")), positions(extended), atol=1e-4)
    assert made.counts == extended.manifest.counts
    assert not work_folder(tmp_path / "m").exists()


def test_votes_are_recorded_only_where_both_drives_had_them(half_maps, halves, map_of, tmp_path):
    voted = map_of(halves[0], passes_vote=True)
    made = update_map(voted, halves[1], tmp_path / "both", passes_vote=True, threads=1)
    assert made.parameters["passes_vote"] == 1.0
    assert "passes_vote" not in update_map(voted, halves[1], tmp_path / "one", threads=1).parameters
    assert (
        "passes_vote" not in update_map(half_maps[0], halves[1], tmp_path / "x", passes_vote=True, threads=1).parameters
    )


def test_a_drive_too_far_from_the_map_is_refused(half_maps, halves, tmp_path, monkeypatch):
    poses = halves[1].survey_poses()
    poses[:, 1, 3] += 300_000.0
    monkeypatch.setattr(halves[1], "survey_poses", lambda: poses)
    with pytest.raises(DatasetError, match=r"scan \d+ is 300 km from the middle of the map"):
        update_map(half_maps[0], halves[1], tmp_path / "m", threads=1)


def test_an_update_removes_dynamic_objects_if_the_map_did(halves, map_of, tmp_path, monkeypatch):
    """A map that was built without the vote gets an update without it. The manifest holds for all surveys of the map."""
    asked = []
    real = ResumedStages.dynamic_voxels

    def listening(*args, each_scan, **more):
        asked.append(each_scan)
        return real(*args, each_scan=each_scan, **more)

    maps = {voted: map_of(halves[0], traffic_vote=voted) for voted in (True, False)}
    monkeypatch.setattr(ResumedStages, "dynamic_voxels", listening)
    for voted, old in maps.items():
        made = update_map(old, halves[1], tmp_path / f"m{voted}", threads=1)
        assert asked == [True] * voted
        assert made.parameters.get("traffic_vote") == (1.0 if voted else None)
        asked.clear()
