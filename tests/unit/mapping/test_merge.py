import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from model_training.mapping import stored_map
from model_training.mapping.join import (
    joined,
    joined_calibration,
    joined_streets,
    of_places,
    require_same,
    standing_apart,
)
from model_training.mapping.merge import merge_maps
from model_training.mapping.stored_map import content_of, voxels_of
from model_training.mapping.verify import damage_of
from service.errors import BundleError, DatasetError
from service.geometry.rigid import rotation_z, transform_from
from service.localization.localizer import Localizer
from service.maps import content as parts
from service.maps.reader import MapBundle
from service.maps.writer import write_bundle
from service.retrieval.query import Query


@pytest.fixture(scope="module")
def merged(half_maps, tmp_path_factory):
    out = tmp_path_factory.mktemp("merged") / "m"
    merge_maps(half_maps[0], half_maps[1], out)
    return MapBundle.open(out)


@pytest.fixture(scope="module")
def whole(small_map):
    return MapBundle.open(small_map)


def positions(bundle):
    return bundle.cloud.unpacked(np.s_[:])["xyz"] + bundle.cloud.origin_m


def nearest_of(points, asked):
    """Return distance and index of the nearest of ``points`` to each query point."""
    return cKDTree(points).query(asked)


def test_a_merged_map_has_the_places_of_one_built_at_once(merged, whole):
    assert merged.manifest.counts.places == whole.manifest.counts.places
    np.testing.assert_allclose(merged.T_map_place[:, :2, 3], whole.T_map_place[:, :2, 3], atol=1e-9)
    np.testing.assert_array_equal(merged.place_street, whole.place_street)
    np.testing.assert_allclose(merged.view_heading_rad, whole.view_heading_rad, atol=1e-9)
    views = np.arange(len(whole.views))
    np.testing.assert_allclose(merged.view_index.vectors(views), whole.view_index.vectors(views), atol=1e-6)


def test_some_places_of_a_map_keep_their_views_and_get_new_numbers(whole):
    content = content_of(whole)
    count = len(content.T_map_place)
    kept = [place for place in range(count) if place not in (0, 3)]
    found = of_places(content, np.isin(np.arange(count), kept))
    np.testing.assert_array_equal(found.T_map_place, content.T_map_place[kept])
    np.testing.assert_array_equal(found.place_street, content.place_street[kept])
    views = [content.headings * place + k for place in kept for k in range(content.headings)]
    np.testing.assert_array_equal(found.descriptors, content.descriptors[views])
    np.testing.assert_array_equal(found.view_heading_rad, content.view_heading_rad[views])
    np.testing.assert_array_equal(found.view_place, np.repeat(np.arange(count - 2), content.headings))


def test_the_ground_under_each_place_stays_where_it_was(merged, whole):
    one, other = (b.T_map_place[:, 2, 3] - b.manifest.lidar_height_m for b in (merged, whole))
    np.testing.assert_allclose(one, other, atol=1e-9)


def test_its_cloud_is_that_of_both_drives(merged, whole):
    assert len(merged.cloud.surfels) == len(whole.cloud.surfels)
    distance, nearest = nearest_of(positions(whole), positions(merged))
    assert distance.max() < 1e-3  # half a step in each map
    a, b = merged.cloud.unpacked(np.s_[:]), whole.cloud.unpacked(nearest)
    np.testing.assert_array_equal(a["points"], b["points"])
    assert np.percentile(np.abs(a["thickness_m"] - b["thickness_m"]), 99) < 1e-3
    assert np.percentile(np.abs((a["normal"] * b["normal"]).sum(axis=1)), 1) > 0.999


def test_it_answers_like_the_map_built_at_once(merged, whole, small_dataset):
    answers = []
    for bundle in (merged, whole):
        localizer = Localizer.open(bundle)
        frames = small_dataset.queries("drive1_precise")
        answers.append(
            [localizer.localize(Query(rgb=f.rgb(), depth_m=f.depth_m(), camera=f.camera.pinhole())) for f in frames]
        )
    for one, other in zip(*answers, strict=True):
        apart_m = np.linalg.norm(one.T_map_camera_guess[:3, 3] - other.T_map_camera_guess[:3, 3])
        assert apart_m < 0.03  # the adjustment ends at a step below 2 cm
        assert one.street == other.street


def test_it_is_whole_and_counts_both_surveys(merged, whole):
    assert damage_of(merged.path) == []
    assert merged.manifest.parameters["survey_scans"] == whole.manifest.parameters["survey_scans"]
    assert merged.manifest.counts.streets == whole.manifest.counts.streets


def test_a_map_merged_with_itself_gains_no_place_and_no_voxel(half_maps, tmp_path):
    made = merge_maps(half_maps[0], half_maps[0], tmp_path / "m", name="twice")
    once, twice = MapBundle.open(half_maps[0]), MapBundle.open(tmp_path / "m")
    assert made.name == "twice"
    np.testing.assert_allclose(twice.T_map_place, once.T_map_place, atol=1e-12)
    voxels = [voxels_of(bundle).statistics() for bundle in (once, twice)]
    np.testing.assert_array_equal(voxels[0]["cell"], voxels[1]["cell"])
    np.testing.assert_array_equal(2 * voxels[0]["points"], voxels[1]["points"])


def test_merging_twice_gives_the_same_version(half_maps, merged, tmp_path):
    assert merge_maps(half_maps[0], half_maps[1], tmp_path / "again").version == merged.manifest.version


def test_bundles_without_sums_merge_by_their_surfels(half_maps, whole, tmp_path):
    """Approximation: a surfel counts as a disc. Voxel means are equal; thickness and normals are close."""
    old = []
    for number, path in enumerate(half_maps):
        bundle = MapBundle.open(path)
        content = replace(content_of(bundle), cloud=bundle.cloud, statistics=None)
        write_bundle(tmp_path / f"old{number}", content)
        assert parts.STATISTICS_FILE not in MapBundle.open(tmp_path / f"old{number}").manifest.files
        old.append(tmp_path / f"old{number}")
    merge_maps(old[0], old[1], tmp_path / "m")
    found = MapBundle.open(tmp_path / "m")
    assert found.cloud is not None
    distance, nearest = nearest_of(positions(whole), positions(found))
    assert np.percentile(distance, 95) < 0.01
    normals = (found.cloud.unpacked(np.s_[:])["normal"], whole.cloud.unpacked(nearest)["normal"])
    cosine = np.abs((normals[0] * normals[1]).sum(axis=1))
    assert np.median(cosine) > 0.98


@pytest.fixture
def content(half_maps):
    return content_of(MapBundle.open(half_maps[0]))


@pytest.mark.parametrize(
    ("what", "change"),
    [
        ("encoder", lambda c: {"encoder": c.encoder + b" "}),
        ("georeference", lambda _: {"georeference": {"latitude_deg": 1.0, "longitude_deg": 2.0, "height_m": 3.0}}),
        ("spacing_m", lambda _: {"spacing_m": 4.0}),
        ("parameters.voxel_m", lambda c: {"parameters": {**c.parameters, "voxel_m": 0.2}}),
        ("parameters.weather_removed", lambda c: {"parameters": {**c.parameters, "weather_removed": 1.0}}),
        ("grid.max_range_m", lambda c: {"grid": replace(c.grid, max_range_m=50.0)}),
        ("rows_seen", lambda c: {"rows_seen": ~c.rows_seen}),
    ],
)
def test_maps_that_do_not_fit_are_refused_with_the_reason(content, what, change):
    other = replace(content, **change(content))
    with pytest.raises(BundleError, match=f"^{what}: ") as refused:
        require_same(content, other, names=("maps/a", "maps/b"))
    assert refused.value.field == what
    assert "maps/a" in refused.value.message
    assert "maps/b" in refused.value.message


def test_another_encoder_is_refused_before_anything_is_written(half_maps, halves, map_of, encoder_of, tmp_path):
    (tmp_path / "other.onnx").write_bytes(encoder_of(seed=5))
    other = map_of(halves[1], encoder=tmp_path / "other.onnx")
    with pytest.raises(BundleError, match="encoder: "):
        merge_maps(half_maps[0], other, tmp_path / "m")
    assert not (tmp_path / "m").exists()


def test_a_folder_that_is_no_bundle_is_refused(half_maps, tmp_path):
    with pytest.raises(BundleError, match=r"not a map bundle: manifest\.json is missing"):
        merge_maps(half_maps[0], tmp_path, tmp_path / "m")


def test_a_name_that_is_taken_is_refused_before_any_work(half_maps, tmp_path):
    told = []
    with pytest.raises(BundleError, match="already"):
        merge_maps(half_maps[0], half_maps[1], tmp_path, report=lambda *event: told.append(event))
    assert told == []


def test_sums_of_another_kind_are_refused(half_maps, tmp_path, monkeypatch):
    monkeypatch.setattr(stored_map, "VOXEL", np.dtype([("cell", "<i4", (3,)), ("other", "u1", (1000,))]))
    with pytest.raises(
        BundleError, match=r"voxels\.zst: not a valid file of voxels .*not a multiple of the record size, 1012 bytes"
    ):
        voxels_of(MapBundle.open(half_maps[0]))


def places_at(*x_m):
    return np.stack([transform_from(rotation_z(0.3), np.array([x, 0.0, 0.0])) for x in x_m])


@pytest.mark.parametrize(
    ("spacing_m", "kept"), [(1.0, [False, False, True, True]), (0.5, [False, True, True, True]), (0.0, [True] * 4)]
)
def test_places_closer_than_the_spacing_less_a_tenth_are_left_out(spacing_m, kept):
    assert standing_apart(places_at(0.1, 0.5, 0.95, 7.0), places_at(0.0), spacing_m).tolist() == kept


def test_next_to_nothing_all_places_stay():
    assert standing_apart(places_at(1.0), np.zeros((0, 4, 4)), 1.0).tolist() == [True]


def test_heights_are_averaged_over_the_places_by_hand(content):
    """Five places at 1.8 m and five at 2.0 m far away give 1.9 m. The first rise by 0.1 m, the second sink by 0.1 m."""
    first = replace(content, parameters={**content.parameters, "lidar_height_m": 1.8})
    moved = content.T_map_place.copy()
    moved[:, 0, 3] += 1000.0
    second = replace(content, T_map_place=moved, parameters={**content.parameters, "lidar_height_m": 2.0})
    found, count = joined(first, second), len(content.T_map_place)
    assert found.parameters["lidar_height_m"] == pytest.approx(1.9)
    np.testing.assert_allclose(found.T_map_place[:count, 2, 3], content.T_map_place[:, 2, 3] + 0.1)
    np.testing.assert_allclose(found.T_map_place[count:, 2, 3], content.T_map_place[:, 2, 3] - 0.1)


def collection(**names):
    features = [{"properties": {"id": key, "name": name}} for key, name in names.items()]
    return {"type": "FeatureCollection", "features": features}


def test_streets_of_both_are_there_once():
    found = joined_streets(collection(a="A", b="B"), collection(b="B", c="C"))
    assert found is not None
    assert [f["properties"]["id"] for f in found["features"]] == ["a", "b", "c"]
    assert joined_streets(None, collection(a="A")) == collection(a="A")
    assert joined_streets(collection(a="A"), None) == collection(a="A")
    assert joined_streets(None, None) is None


def test_a_street_that_differs_is_refused_unless_the_newer_holds():
    with pytest.raises(BundleError, match="both maps have a street 'b', but the two differ"):
        joined_streets(collection(b="B"), collection(b="other"))
    assert joined_streets(collection(b="B"), collection(b="other"), newer=True) == collection(b="other")


def outlined(*corners):
    geometry = {"type": "Polygon", "coordinates": [[*corners, corners[0]]]}
    return {"type": "FeatureCollection", "features": [{"properties": {"id": "a"}, "geometry": geometry}]}


def test_streets_of_one_id_are_the_same_if_their_outlines_lie_within_a_tenth_of_a_metre():
    street = outlined([0, 0], [5, 5], [10, 0], [10, 10], [0, 10])
    for y in (-0.09, 0.09):
        assert joined_streets(street, outlined([0, y], [5, 5], [10, y], [10, 10], [0, 10])) == street
    with pytest.raises(BundleError, match="both maps have a street 'a', but the two differ"):
        joined_streets(street, outlined([0, 0.2], [5, 5], [10, 0], [10, 10], [0, 10]))


def test_outlines_that_connect_the_same_corners_otherwise_differ():
    """One square has its notch at the bottom, the other one at the top."""
    bottom, top = ([0, 0], [5, 5], [10, 0], [10, 10], [0, 10]), ([0, 0], [10, 0], [10, 10], [5, 5], [0, 10])
    with pytest.raises(BundleError, match="both maps have a street 'a', but the two differ"):
        joined_streets(outlined(*bottom), outlined(*top))


@pytest.mark.parametrize("geometry", [None, {"type": "Polygon", "coordinates": [[["east", 2.0]]]}, {"type": "Polygon"}])
def test_a_street_without_a_valid_outline_differs(geometry):
    street = outlined([0, 0], [10, 0], [10, 10])
    damaged = {"type": "FeatureCollection", "features": [{"properties": {"id": "a"}, "geometry": geometry}]}
    with pytest.raises(BundleError, match="both maps have a street 'a', but the two differ"):
        joined_streets(street, damaged)


SITE = {"offset": -0.2, "queries": 20, "right": 18, "expected_calibration_error": 0.1}


def test_site_checks_add_up_and_the_lower_offset_holds():
    calibration = {"calibrated": True, "right": 1}
    other = {"offset": -0.5, "queries": 60, "right": 50, "expected_calibration_error": 0.3}
    found = joined_calibration({**calibration, "site": SITE}, {**calibration, "site": other})
    assert found["site"] == {
        "offset": -0.5,
        "queries": 80,
        "right": 68,
        "expected_calibration_error": pytest.approx(0.25),
    }
    assert joined_calibration({**calibration, "site": None}, {**calibration, "site": SITE})["site"] == SITE
    assert joined_calibration({**calibration, "site": None}, {**calibration, "site": None})["site"] is None


def test_a_correction_for_a_rig_stays_only_if_both_maps_have_the_same():
    one, other = ({"calibrated": True, "site": None, "rig": {"scale": scale}} for scale in (0.5, 0.6))
    none = {"calibrated": True, "site": None, "rig": None}
    assert joined_calibration(one, one)["rig"] == {"scale": 0.5}
    assert joined_calibration(one, other)["rig"] is None
    assert joined_calibration(one, none)["rig"] is None
    assert joined_calibration(none, {"calibrated": True, "site": None})["rig"] is None


def test_of_several_corrections_those_stay_that_both_maps_have():
    none, a, b = {"calibrated": True, "site": None}, {"name": "a", "scale": 0.5}, {"name": "b", "scale": 0.6}
    changed = a | {"scale": 0.7}
    assert joined_calibration(none | {"rigs": [a, b]}, none | {"rigs": [b, a]})["rigs"] == [a, b]
    assert joined_calibration(none | {"rigs": [a, b]}, none | {"rigs": [changed, b]})["rigs"] == [b]
    for other in (none, none | {"rigs": [changed]}):
        assert "rigs" not in joined_calibration(none | {"rigs": [a]}, other)
        assert "rigs" not in joined_calibration(other, none | {"rigs": [a]})


def test_with_an_uncalibrated_map_the_whole_is_uncalibrated():
    none = {"calibrated": False, "why": "because"}
    assert joined_calibration({"calibrated": True, "site": None}, none) == none
    assert joined_calibration(none, {"calibrated": True, "site": None}) == none


def test_different_calibrations_are_refused():
    with pytest.raises(BundleError, match="the maps have different ones"):
        joined_calibration(
            {"calibrated": True, "right": 1, "site": None}, {"calibrated": True, "right": 2, "site": None}
        )


def test_a_truncated_file_is_refused(half_maps, tmp_path):
    damaged = shutil.copytree(half_maps[0], tmp_path / "damaged")
    data = (damaged / "places.npy").read_bytes()
    (damaged / "places.npy").write_bytes(data[:-7])
    with pytest.raises(BundleError, match=rf"places\.npy: {len(data) - 7} bytes instead of {len(data)}"):
        merge_maps(damaged, half_maps[1], tmp_path / "m")


def test_the_manifest_is_of_the_same_format(merged):
    assert (
        json.loads((merged.path / "manifest.json").read_text()).keys() == json.loads(merged.manifest.to_bytes()).keys()
    )


def test_brightness_of_a_merged_map_is_that_of_both_surveys(merged, whole):
    """The mean counts the returns of both surveys."""
    distance, nearest = nearest_of(positions(whole), positions(merged))
    same = distance < 1e-4
    assert same.mean() > 0.95
    one, other = merged.cloud.brightness[same], whole.cloud.brightness[nearest[same]]
    assert np.isfinite(other).all()
    np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-5)
    assert other.std() > 0.1 * other.mean()


def test_maps_too_far_apart_for_one_cloud_are_refused(half_maps, tmp_path):
    content = content_of(MapBundle.open(half_maps[1]))
    moved = content.T_map_place.copy()
    moved[:, 0, 3] += 200_000.0
    write_bundle(tmp_path / "far", replace(content, T_map_place=moved, cloud=None, statistics=None))
    with pytest.raises(DatasetError, match=r"far: place \d+ is 200 km from the middle of the map"):
        merge_maps(half_maps[0], tmp_path / "far", tmp_path / "m")
    assert not (tmp_path / "m").exists()


def test_a_joined_map_states_the_worse_accuracy_of_both_surveys(whole):
    content = content_of(whole)
    first = replace(content, parameters={**content.parameters, "survey_position_std_m": 0.02})
    second = replace(
        content,
        T_map_place=content.T_map_place + np.array([[0, 0, 0, 1000.0], [0] * 4, [0] * 4, [0] * 4]),
        parameters={**content.parameters, "survey_position_std_m": 0.08, "survey_angle_std_deg": 0.1},
    )
    require_same(first, second, names=("one", "other"))
    found = joined(first, second).parameters
    assert (found["survey_position_std_m"], found["survey_angle_std_deg"]) == (0.08, 0.1)


def test_maps_of_other_surveyed_heights_are_joined(whole):
    """Two traversals past houses of other heights may differ. The joined cloud is measured again."""
    content = content_of(whole)
    other = replace(content, parameters={**content.parameters, "surveyed_height_m": 1.0})
    require_same(content, other, names=("one", "other"))
