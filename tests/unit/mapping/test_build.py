import shutil
from dataclasses import replace

import numpy as np
import pytest

from model_training.datasets.dataset import Dataset, SurveyAccuracy
from model_training.mapping import build, site_check, work
from model_training.mapping.build import build_map, describe
from model_training.mapping.settings import BuildSettings
from model_training.mapping.survey import fan, thinned, view_ranges
from service.errors import BundleError, DatasetError, EncoderError
from service.localization.localizer import Localizer
from service.maps.calibration import Site
from service.maps.reader import MapBundle
from service.retrieval.encoder import Encoder
from service.retrieval.query import Query

SETTINGS = BuildSettings(
    name="small", headings=6, spacing_m=5.0, between_m=0.0, calibration=None, align_survey=False, traffic_vote=False
)


@pytest.mark.parametrize(
    ("field", "value", "least"),
    [
        ("spacing_m", -1.0, "0"),
        ("between_m", -1.0, "0"),
        ("headings", 0, "1"),
        ("voxel_m", 0.0, "0.01"),
        ("voxel_m", np.nan, "0.01"),
        ("expected_lidar_height_m", np.inf, "0.1"),
    ],
)
def test_settings_that_make_no_map_are_refused_by_name(field, value, least):
    with pytest.raises(DatasetError, match=f"{field}: {value:g} is not valid; give {least} or more") as refused:
        BuildSettings(name="none", **{field: value})
    assert refused.value.field == field


def track(steps_m):
    poses = np.tile(np.eye(4), (len(steps_m) + 1, 1, 1))
    poses[1:, 0, 3] = np.cumsum(steps_m)
    return poses


@pytest.fixture(scope="module")
def bundle(small_map):
    return MapBundle.open(small_map)


@pytest.mark.parametrize(
    ("steps_m", "spacing_m", "kept"),
    [
        ([1.0] * 4, 1.0, [0, 1, 2, 3, 4]),
        ([0.06] * 50, 1.0, [0, 15, 30, 45]),
        ([0.4] * 6, 1.0, [0, 3, 6]),
        ([5.0, 0.2, 5.0], 1.0, [0, 1, 3]),
    ],
)
def test_places_stand_the_spacing_apart_along_the_way(steps_m, spacing_m, kept):
    """The least spacing is a tenth smaller, so that noisy poses do not double the spacing."""
    assert thinned(track(steps_m), spacing_m).tolist() == kept


def test_a_standing_vehicle_makes_one_place():
    assert thinned(track([0.0] * 9), 1.0).tolist() == [0]


def test_a_fan_goes_all_round_in_even_steps():
    np.testing.assert_allclose(np.rad2deg(fan(6)), [0, 60, 120, 180, 240, 300])


def test_a_built_map_opens_and_verifies_with_the_right_counts(small_dataset, bundle):
    places = len(thinned(small_dataset.survey_poses(), 5.0))
    counts = bundle.manifest.counts
    assert (counts.places, counts.views, counts.descriptor_size) == (places, 6 * places, 16)
    assert counts.streets == len(small_dataset.streets()["features"])
    assert counts.cloud_points > 1000


def test_places_lie_where_the_survey_drove(small_dataset, bundle):
    np.testing.assert_allclose(bundle.T_map_place[:, :2, 3], small_dataset.survey_poses()[:, :2, 3], atol=0.2)


def test_places_know_their_street(bundle):
    """The first place is on the edge of its street. Its pose error may move it outside."""
    assert set(bundle.place_street[1:].tolist()) == {0}


def test_rows_above_a_lidar_that_looks_down_are_not_seen(bundle):
    elevations = np.rad2deg(bundle.grid.elevations_rad)
    assert not bundle.rows_seen[elevations > 5].any()
    assert bundle.rows_seen[elevations < 0].all()


def test_views_of_a_place_look_in_different_directions(bundle):
    of_one = np.rad2deg(bundle.view_heading_rad[bundle.view_place == 2])
    turns = np.sort((of_one - of_one[0]) % 360)
    np.testing.assert_allclose(turns, np.arange(6) * 60, atol=1e-6)


def test_the_ground_under_every_place_lies_one_lidar_height_below(small_dataset, bundle):
    height_m = bundle.manifest.lidar_height_m
    assert height_m == pytest.approx(1.8, abs=0.1)
    written = small_dataset.survey_poses()[:, 2, 3]
    np.testing.assert_allclose(bundle.T_map_place[:, 2, 3], written, atol=0.15)


def test_the_same_build_twice_has_the_same_version(small_dataset, encoder_file, bundle, tmp_path):
    again = build_map(small_dataset, encoder_file, tmp_path / "again", SETTINGS, threads=1)
    assert again.version == bundle.manifest.version


def test_another_spacing_has_another_version_and_fewer_places(small_dataset, encoder_file, bundle, tmp_path):
    settings = replace(SETTINGS, spacing_m=15.0)
    other = build_map(small_dataset, encoder_file, tmp_path / "other", settings, threads=1)
    assert other.version != bundle.manifest.version
    assert other.counts.places < bundle.manifest.counts.places
    assert other.spacing_m == 15.0


def test_weather_removal_is_recorded(small_dataset, encoder_file, tmp_path):
    settings = BuildSettings(name="dry", headings=2, spacing_m=20.0, remove_weather=True, calibration=None)
    assert (
        build_map(small_dataset, encoder_file, tmp_path / "dry", settings, threads=1).parameters["weather_removed"]
        == 1.0
    )


def test_progress_is_reported_for_every_place(small_dataset, encoder_file, bundle, tmp_path):
    told = []
    build_map(
        small_dataset,
        encoder_file,
        tmp_path / "told",
        replace(SETTINGS, traffic_vote=True),
        threads=1,
        report=lambda *event: told.append(event),
    )
    count = bundle.manifest.counts.places
    assert told == [
        *(("places", k, count) for k in range(1, count + 1)),
        ("places", count, count),
        *(("traffic", k, count) for k in range(1, count + 1)),
        ("traffic", count, count),
        *(("writing", k, 2) for k in range(3)),
    ]


def test_pictures_of_another_drive_are_answered(small_dataset, bundle):
    """The encoder is untrained, so we check that there is an answer, not that it is right."""
    localizer = Localizer.open(bundle)
    for frame in small_dataset.queries("drive1_precise"):
        answer = localizer.localize(Query(rgb=frame.rgb(), depth_m=frame.depth_m(), camera=frame.camera.pinhole()))
        assert np.isfinite(answer.T_map_camera_guess).all()
        assert answer.vote is not None
        assert len(answer.neighbours) == 5


def test_view_ranges_are_blank_in_rows_that_are_not_seen(small_dataset, bundle):
    fans = list(view_ranges(small_dataset, SETTINGS, bundle.grid, bundle.rows_seen))
    assert len(fans) == bundle.manifest.counts.places
    assert fans[0].shape == (6, 8, 16)
    assert not fans[0][:, ~bundle.rows_seen].any()
    assert fans[0][:, bundle.rows_seen].any()


def test_a_map_that_is_there_is_refused_before_any_work(small_dataset, encoder_file, small_map):
    told = []
    with pytest.raises(BundleError, match="already"):
        build_map(small_dataset, encoder_file, small_map, SETTINGS, report=lambda *event: told.append(event))
    assert told == []


@pytest.fixture
def own_dataset(small_dataset, tmp_path):
    return shutil.copytree(small_dataset.folder, tmp_path / "own")


def test_an_empty_survey_is_refused(own_dataset, encoder_file, tmp_path):
    (own_dataset / "survey" / "poses.txt").write_text("")
    with pytest.raises(DatasetError, match=r"poses\.txt is empty"):
        build_map(Dataset(own_dataset), encoder_file, tmp_path / "out", SETTINGS, threads=1)


def test_a_truncated_scan_is_named_and_no_map_appears(own_dataset, encoder_file, tmp_path):
    path = own_dataset / "survey" / "scans" / "000003.bin"
    path.write_bytes(path.read_bytes()[:-5])
    with pytest.raises(DatasetError, match=r"000003\.bin"):
        build_map(Dataset(own_dataset), encoder_file, tmp_path / "out", SETTINGS, threads=1)
    assert not (tmp_path / "out").exists()


def test_scans_in_millimetres_are_refused_with_a_hint(own_dataset, encoder_file, tmp_path):
    for path in (own_dataset / "survey" / "scans").iterdir():
        points = np.fromfile(path, np.float32).reshape(-1, 4)
        points[:, :3] *= 1000
        points.tofile(path)
    with pytest.raises(DatasetError, match="check units and axes"):
        build_map(Dataset(own_dataset), encoder_file, tmp_path / "out", SETTINGS, threads=1)


def test_a_file_that_is_no_encoder_is_refused(small_dataset, tmp_path):
    (tmp_path / "encoder.onnx").write_bytes(b"nothing of the kind")
    with pytest.raises(EncoderError):
        build_map(small_dataset, tmp_path / "encoder.onnx", tmp_path / "out", SETTINGS, threads=1)


@pytest.fixture
def calibration_file(calibration_file_of, encoder_file):
    """Return a calibration that gives 0.5 for all features, measured with this encoder."""
    return calibration_file_of(Encoder.open(encoder_file).sha256)


def test_without_a_calibration_of_its_encoder_a_map_says_that_it_has_none(
    small_dataset, encoder_file, bundle, calibration_file_of, tmp_path
):
    assert bundle.calibration is None
    settings = replace(SETTINGS, calibration=calibration_file_of("0" * 64))
    other = build_map(small_dataset, encoder_file, tmp_path / "other", settings, threads=1)
    assert MapBundle.open(tmp_path / "other").calibration is None
    assert other.version == bundle.manifest.version


def test_a_calibration_of_its_encoder_goes_into_the_map_unchecked_where_places_are_few(
    small_dataset, encoder_file, bundle, calibration_file, tmp_path
):
    settings = replace(SETTINGS, calibration=calibration_file)
    build_map(small_dataset, encoder_file, tmp_path / "sure", settings, threads=1)
    sure = MapBundle.open(tmp_path / "sure")
    assert sure.calibration is not None
    assert sure.calibration.site is None
    assert sure.calibration.known.bias == pytest.approx(np.log(3))
    assert sure.manifest.counts == bundle.manifest.counts


def test_some_scans_are_held_out_to_check_it_and_are_in_the_map_all_the_same(
    small_dataset, encoder_file, bundle, calibration_file, tmp_path, monkeypatch
):
    """Every fourth place is held out. The untrained encoder answers wrongly, so 0.5 is too high and is lowered."""
    monkeypatch.setattr(site_check, "_EACH", 4)
    monkeypatch.setattr(site_check, "FEWEST", 2)
    settings, told = replace(SETTINGS, calibration=calibration_file), []
    build_map(
        small_dataset, encoder_file, tmp_path / "m", settings, threads=1, report=lambda *event: told.append(event)
    )
    checked = MapBundle.open(tmp_path / "m")
    assert checked.calibration is not None
    site, places = checked.calibration.site, bundle.manifest.counts.places
    assert site is not None
    assert site.queries == places // 4 >= 2
    assert [event for event in told if event[0] == "site check"] == [
        ("site check", k + 1, site.queries) for k in range(site.queries)
    ]
    assert 0 <= site.right <= site.queries
    assert site.offset <= 0
    assert checked.manifest.counts == bundle.manifest.counts
    np.testing.assert_array_equal(checked.T_map_place, bundle.T_map_place)
    assert checked.cloud is not None
    x, expected = (np.sort(cloud.unpacked(np.s_[:])["xyz"][:, 0]) for cloud in (checked.cloud, bundle.cloud))
    np.testing.assert_allclose(x, expected, atol=1e-3)


def test_a_sparse_survey_gets_places_between_its_scans(small_dataset, encoder_file, bundle, tmp_path):
    settings = replace(SETTINGS, between_m=3.0)
    build_map(small_dataset, encoder_file, tmp_path / "m", settings, threads=1)
    found = MapBundle.open(tmp_path / "m")
    scans, places = bundle.manifest.counts.places, found.manifest.counts.places
    gaps_m = np.linalg.norm(np.diff(bundle.T_map_place[:, :3, 3], axis=0), axis=1)
    assert 3.0 < gaps_m.min() <= gaps_m.max() <= 6.0  # so each gap has one place, and both ends have two more
    assert places - scans == len(gaps_m) + 4
    assert found.manifest.parameters["places_between"] == places - scans
    np.testing.assert_allclose(found.T_map_place[:scans, :2, 3], bundle.T_map_place[:, :2, 3], atol=1e-9)
    first, second = bundle.T_map_place[:2, :2, 3]
    expected = [0.5 * (first + second), 1.5 * first - 0.5 * second, 2.0 * first - second]
    np.testing.assert_allclose(found.T_map_place[scans : scans + 3, :2, 3], expected, atol=1e-6)
    assert found.cloud is not None
    np.testing.assert_array_equal(found.cloud.surfels["points"], bundle.cloud.surfels["points"])


def test_a_scan_that_is_held_out_takes_no_part_in_the_map_to_check(
    small_dataset, encoder_file, calibration_file, tmp_path, monkeypatch
):
    monkeypatch.setattr(site_check, "_EACH", 4)
    monkeypatch.setattr(site_check, "FEWEST", 2)
    checked = []

    def noted(content_of, held, *_):
        checked.append((content_of().T_map_place[:, :2, 3], [scan.T_map_level[:2, 3] for scan in held]))
        return Site(offset=0.0, queries=len(held), right=0, expected_calibration_error=0.0)

    monkeypatch.setattr(build, "site_of", noted)
    settings = replace(SETTINGS, calibration=calibration_file, between_m=3.0)
    build_map(small_dataset, encoder_file, tmp_path / "m", settings, threads=1)
    ((places_xy, held_xy),) = checked
    for xy in held_xy:  # scans are 5 m apart; those between them 2.5 m
        assert np.hypot(*(places_xy - xy).T).min() > 4.0


def test_a_killed_build_continues_with_places_between_chunks(small_dataset, encoder_file, tmp_path, monkeypatch):
    """A chunk of three scans ends in the middle of a gap. The next chunk puts the places there."""
    settings = replace(SETTINGS, between_m=3.0)
    build_map(small_dataset, encoder_file, tmp_path / "whole", settings, threads=1)
    monkeypatch.setattr(work, "CHUNK", 3)
    build_map(small_dataset, encoder_file, tmp_path / "chunks", settings, threads=1)
    whole, chunks = MapBundle.open(tmp_path / "whole"), MapBundle.open(tmp_path / "chunks")
    np.testing.assert_array_equal(chunks.T_map_place, whole.T_map_place)
    views = np.arange(len(whole.views))
    np.testing.assert_array_equal(chunks.view_index.vectors(views), whole.view_index.vectors(views))


def test_a_calibration_that_is_missing_or_none_stops_the_build_before_any_place(small_dataset, encoder_file, tmp_path):
    told = []
    (tmp_path / "none.json").write_text("{}")
    for name, error, message in (
        ("missing.json", DatasetError, "missing.json cannot be read .*create it with streetfix calibrate"),
        ("none.json", BundleError, "the field calibrated is missing or not a boolean"),
    ):
        settings = replace(SETTINGS, calibration=tmp_path / name)
        with pytest.raises(error, match=message):
            build_map(
                small_dataset,
                encoder_file,
                tmp_path / "out",
                settings,
                threads=1,
                report=lambda *event: told.append(event),
            )
    assert told == []
    assert not (tmp_path / "out").exists()


def test_a_map_is_described_in_one_line(bundle):
    text = describe(bundle.manifest)
    assert text.startswith(f"map small, version {bundle.manifest.version}: {bundle.manifest.counts.places} places")


def test_a_survey_with_poses_of_two_frames_is_refused_before_the_work(small_dataset, encoder_file, tmp_path):
    """One pose is in UTM, the others are local. Its voxels would have had the keys of others."""

    class OneInUtm(Dataset):
        def survey_poses(self):
            poses = super().survey_poses()
            poses[7, :2, 3] = [447_000.0, 5_411_000.0]
            return poses

    told = []
    with pytest.raises(DatasetError, match=r"survey/poses\.txt: scan 7 is .* km from the middle of the map"):
        build_map(
            OneInUtm(small_dataset.folder),
            encoder_file,
            tmp_path / "m",
            SETTINGS,
            report=lambda *each: told.append(each),
        )
    assert told == []
    assert not (tmp_path / "m").exists()


def test_the_traffic_vote_is_on_by_default(small_dataset, encoder_file, bundle, tmp_path):
    assert BuildSettings(name="any").traffic_vote
    assert "traffic_vote" not in bundle.manifest.parameters
    settings = replace(SETTINGS, traffic_vote=True)
    made = build_map(small_dataset, encoder_file, tmp_path / "without traffic", settings, threads=1)
    assert made.parameters["traffic_vote"] == 1.0
    assert made.counts.cloud_points <= bundle.manifest.counts.cloud_points


STATED = SurveyAccuracy(position_std_m=0.08, angle_std_deg=0.1)


@pytest.mark.parametrize(
    ("options", "stated", "expected"),
    [
        ({}, None, {}),
        ({}, STATED, {"survey_position_std_m": 0.08, "survey_angle_std_deg": 0.1}),
        ({"survey_std_m": 0.0}, STATED, {"survey_position_std_m": 0.0, "survey_angle_std_deg": 0.1}),
        ({"survey_std_deg": 0.2}, None, {"survey_angle_std_deg": 0.2}),
    ],
)
def test_a_given_accuracy_of_the_survey_comes_before_the_stated_one(options, stated, expected):
    assert BuildSettings(name="any", **options).survey_accuracy(stated) == expected


@pytest.mark.parametrize("field", ["survey_std_m", "survey_std_deg"])
@pytest.mark.parametrize("value", [-0.1, 5.1, float("nan")])
def test_an_accuracy_out_of_bounds_is_refused(field, value):
    with pytest.raises(DatasetError, match=rf"^{field}: .* is not valid; give 0 to 5$") as error:
        BuildSettings(name="any", **{field: value})
    assert error.value.field == field
