import json

import numpy as np
import pytest

from model_training.datasets.dataset import Dataset
from model_training.importing.recording import Unusable
from model_training.importing.take import TakeSettings, scans_of, take
from service.errors import DatasetError
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import R_BODY_OPTICAL, transform_from


@pytest.fixture
def taken(recording_of, straight, tmp_path):
    """Take events with a straight trajectory; return the summary and the dataset."""

    def made(events, **settings):
        summary = take(recording_of(events), straight(), tmp_path / "out", TakeSettings(**settings))
        return summary, Dataset(tmp_path / "out")

    return made


def test_scans_and_pictures_stand_where_the_trajectory_was(taken, scan_at, picture_at):
    summary, dataset = taken([scan_at(1.0), picture_at(1.05), scan_at(1.25)])
    assert (summary.scans, summary.pictures, summary.dropped) == (2, 1, ())
    np.testing.assert_allclose(dataset.survey_poses()[:, 0, 3], [1.0, 1.25], atol=1e-9)
    (query,) = dataset.queries("recorded")
    np.testing.assert_allclose(query.T_map_camera, transform_from(R_BODY_OPTICAL, np.array([1.05, 0, 0])), atol=1e-8)
    np.testing.assert_array_equal(query.rgb(), picture_at(1.05).rgb)
    np.testing.assert_allclose(query.depth_m(), 2.5)
    assert dataset.description.source["kind"] == "listed"
    assert dataset.description.source["poses"] == "straight on"


def test_unusable_items_are_counted_by_reason_with_the_first_name(taken, scan_at, picture_at):
    nan = [[np.nan, 0, 0, 0]]
    events = [
        scan_at(0.5),
        scan_at(0.4),
        scan_at(0.5),
        scan_at(np.nan),
        scan_at(0.6, points=nan),
        scan_at(99.0),
        Unusable("scan", "a.bin", "truncated"),
        Unusable("scan", "b.bin", "truncated"),
        picture_at(0.7, depth=None),
        picture_at(0.8, depth=np.zeros((6, 8), np.float32)),
        picture_at(0.9, depth=np.ones((3, 4), np.float32)),
        picture_at(99.0),
        scan_at(1.0),
    ]
    summary, dataset = taken(events)
    assert (summary.scans, summary.pictures) == (2, 0)
    assert summary.dropped[:2] == (
        "3 scans: its time is not later than that of the scan before (first: scan at 0.4)",
        "2 scans: truncated (first: a.bin)",
    )
    assert set(summary.dropped[2:]) == {
        "1 scan: no finite points (first: scan at 0.6)",
        "1 scan: after the last pose (first: scan at 99)",
        "1 image: no depth in the recording; --depth lidar takes it from the scans (first: picture at 0.7)",
        "1 image: its depth is empty (first: picture at 0.8)",
        "1 image: sizes differ: colour (6, 8), depth (3, 4), camera (6, 8) (first: picture at 0.9)",
        "1 image: after the last pose (first: picture at 99)",
    }
    assert dataset.description.source["dropped"] == list(summary.dropped)


def test_points_that_are_no_numbers_are_left_out_and_counted(taken, scan_at):
    points = [[1, 2, 3, 4], [np.nan, 0, 0, 0], [0, np.inf, 0, 0], [5, 6, 7, 8]]
    summary, dataset = taken([scan_at(1.0, points=points, offsets_s=[0, np.nan, 0, 0])])
    assert summary.points_without_numbers == 2
    np.testing.assert_array_equal(dataset.scan(0), np.array(points)[[0, 3]])


def test_a_turns_motion_is_taken_out_unless_it_is_to_stay(recording_of, straight, scan_at, tmp_path):
    scan = scan_at(1.0, points=[[5, 0, 0, 0]] * 2, offsets_s=[0.0, 0.1])
    for deskew, x in ((True, 6.0), (False, 5.0)):
        out = tmp_path / str(deskew)
        take(recording_of([scan]), straight(speed=10.0), out, TakeSettings(deskew=deskew))
        np.testing.assert_allclose(Dataset(out).scan(0)[:, 0], [5.0, x], atol=1e-4)


def test_times_of_another_clock_do_not_change_the_points_and_are_reported(taken, scan_at):
    summary, dataset = taken([scan_at(1.0, points=[[5, 0, 0, 0]], offsets_s=[523.0])])
    np.testing.assert_array_equal(dataset.scan(0), [[5, 0, 0, 0]])
    assert summary.dropped == ("1 de-skew: its points' times are more than 1 s from its stamp (first: scan at 1)",)


def test_every_third_scan_is_held_out_with_the_pictures_nearest_to_it(taken, scan_at, picture_at):
    events = sorted(
        [scan_at(0.5 * k) for k in range(1, 8)] + [picture_at(0.5 * k + 0.1) for k in range(1, 7)],
        key=lambda e: e.stamp_s,
    )
    summary, dataset = taken(events, hold_out=3)
    assert (summary.scans, summary.held_out, summary.pictures) == (5, 2, 2)
    np.testing.assert_allclose(dataset.survey_trajectory()[0], [0.5, 1.0, 2.0, 2.5, 3.5])
    assert [query.stamp_s for query in dataset.queries("recorded")] == [1.6, 3.1]
    assert summary.dropped == (
        "4 images: the scan nearest to it is in the survey (--hold-out) (first: picture at 0.6)",
    )


def test_a_picture_belongs_to_the_nearest_scan_also_when_that_comes_later(taken, scan_at, picture_at):
    summary, _ = taken([scan_at(1.0), picture_at(1.4), scan_at(1.5), scan_at(2.0)], hold_out=2)
    assert (summary.held_out, summary.pictures) == (1, 1)


def test_pictures_without_any_scan_after_them_wait_in_bounded_number(
    recording_of, straight, scan_at, picture_at, tmp_path
):
    """All images of the drive come at the end, as ``convert`` writes it. Each becomes a query as it arrives."""
    waiting = []

    def events():
        yield scan_at(0.5)
        yield scan_at(1.0)
        for k in range(100):
            waiting.append(len(list((tmp_path / ".out.part").glob("queries/*/rgb/*"))))
            yield picture_at(1.0 + 0.01 * k)

    summary = take(recording_of(events()), straight(), tmp_path / "out", TakeSettings(hold_out=2))
    assert summary.pictures == 100
    assert max(k - written for k, written in enumerate(waiting)) <= 33


def test_pictures_are_left_out_where_no_query_set_is_wanted(taken, scan_at, picture_at):
    summary, dataset = taken([scan_at(1.0), picture_at(1.0)], queries="")
    assert summary.pictures == 0
    assert dataset.query_sets() == []


def wall_scan(scan_at, stamp_s, x):
    """Return a scan of a wall across the road, ``x`` metres ahead of the LiDAR."""
    y, z = (a.ravel() for a in np.meshgrid(np.linspace(-4, 4, 60), np.linspace(-3, 3, 60)))
    return scan_at(stamp_s, points=np.c_[np.full(y.shape, x), y, z, np.zeros(y.shape)])


def test_depth_of_a_lidar_is_where_the_vehicle_is_at_the_picture(taken, scan_at, picture_at):
    camera = PinholeCamera(32, 24, 30.0, 30.0, 15.5, 11.5)
    picture = picture_at(1.08, camera=camera, rgb=np.zeros((24, 32, 3), np.uint8), depth=None)
    lonely = picture_at(3.0, camera=camera, rgb=np.zeros((24, 32, 3), np.uint8), depth=None)
    summary, dataset = taken(
        [wall_scan(scan_at, 1.0, 6.0), picture, wall_scan(scan_at, 1.5, 5.5), lonely], depth="lidar"
    )
    (query,) = dataset.queries("recorded")
    depth = query.depth_m()[4:20, 4:28]
    np.testing.assert_allclose(depth, 5.92, atol=0.001)
    assert summary.dropped == ("1 image: no scan within 0.1 s (first: picture at 3)",)


def test_a_bent_picture_is_rectified_on_the_way_in(taken, scan_at, picture_at):
    camera = PinholeCamera(8, 6, 8.0, 8.0, 3.5, 2.5, (-0.2, 0.0, 0.0, 0.0))
    _, dataset = taken([scan_at(1.0), picture_at(1.0, camera=camera)])
    (query,) = dataset.queries("recorded")
    assert (query.rgb() != picture_at(1.0).rgb).any()


def test_each_camera_of_a_recording_keeps_its_own_intrinsics(taken, scan_at, picture_at):
    wide = PinholeCamera(8, 6, 4.0, 4.0, 3.5, 2.5)
    _, dataset = taken([scan_at(1.0), picture_at(1.0), picture_at(1.1, camera=wide), picture_at(1.2)])
    assert [query.camera.fx for query in dataset.queries("recorded")] == [8.0, 4.0, 8.0]


def test_depth_too_far_for_sixteen_bits_is_no_depth(taken, scan_at, picture_at):
    depth = np.full((6, 8), 3.0, np.float32)
    depth[0, :4] = 65.536, np.inf, np.nan, -1.0
    _, dataset = taken([scan_at(1.0), picture_at(1.0, depth=depth)])
    (query,) = dataset.queries("recorded")
    np.testing.assert_allclose(query.depth_m()[0], [0, 0, 0, 0, 3, 3, 3, 3])


def test_no_usable_scan_is_an_error_with_the_reasons_and_leaves_nothing(recording_of, straight, scan_at, tmp_path):
    events = [scan_at(99.0), Unusable("scan", "a.bin", "truncated")]
    with pytest.raises(DatasetError, match=r"list: no scan is usable \(1 scan: after the last pose .*truncated"):
        take(recording_of(events), straight(), tmp_path / "out", TakeSettings())
    with pytest.raises(DatasetError, match="the recording has none"):
        take(recording_of([]), straight(), tmp_path / "out", TakeSettings())
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("end", [KeyboardInterrupt, OSError("the disk is full")])
def test_a_run_that_ends_early_leaves_nothing(recording_of, straight, scan_at, picture_at, tmp_path, end):
    with pytest.raises(KeyboardInterrupt if end is KeyboardInterrupt else OSError):
        take(
            recording_of([scan_at(1.0), picture_at(1.0), end if isinstance(end, BaseException) else end()]),
            straight(),
            tmp_path / "out",
            TakeSettings(),
        )
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_is_taken_is_refused_untouched(recording_of, straight, scan_at, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine").write_text("keep")
    with pytest.raises(DatasetError, match="exists and is not empty"):
        take(recording_of([scan_at(1.0)]), straight(), tmp_path / "out", TakeSettings())
    assert (tmp_path / "out" / "mine").read_text() == "keep"


@pytest.mark.parametrize(
    ("settings", "field"),
    [
        ({"hold_out": 1}, "hold_out"),
        ({"hold_out": -2}, "hold_out"),
        ({"tolerance_s": np.nan}, "tolerance_s"),
        ({"tolerance_s": -1}, "tolerance_s"),
    ],
)
def test_settings_that_make_no_sense_are_refused_by_name(settings, field):
    with pytest.raises(DatasetError, match=f"^{field}: "):
        TakeSettings(**settings)


def test_millimetres_as_floats_are_left_out_with_the_unit(taken, scan_at, picture_at):
    summary, _ = taken([scan_at(0.4), picture_at(0.5, depth=np.full((6, 8), 2500, np.float32)), picture_at(0.6)])
    assert summary.pictures == 1
    (line,) = summary.dropped
    assert line == (
        "1 image: its floating-point depth looks like millimetres, but metres are expected: divide it by 1000, or record "
        "16-bit integers (first: picture at 0.5)"
    )


def test_progress_is_reported_after_every_frame(recording_of, straight, scan_at, tmp_path):
    told = []
    events = [scan_at(1.0), Unusable("scan", "x", "y"), scan_at(2.0)]
    take(recording_of(events), straight(), tmp_path / "out", TakeSettings(), report=lambda *each: told.append(each))
    assert told == [("frames", 1, 10), ("frames", 2, 10), ("frames", 3, 10)]


def test_the_dataset_description_is_json_with_the_lidar(taken, scan_at):
    _, dataset = taken([scan_at(1.0)])
    told = json.loads((dataset.folder / "dataset.json").read_text())
    assert told["sensors"]["lidars"][0]["name"] == "listed"
    assert told["source"]["hold_out"] == 0


def test_odometry_reads_usable_scans_alone(recording_of, scan_at, picture_at):
    nan = np.nan
    events = [
        scan_at(1.0, points=[[nan, 0, 0, 0], [1, 2, 3, 4]], offsets_s=[0.0, 0.1]),
        picture_at(1.0),
        scan_at(0.9),
        scan_at(1.1, points=[[nan] * 4]),
        Unusable("scan", "x", "y"),
        scan_at(2.0, offsets_s=[99.0]),
    ]
    first, second = scans_of(recording_of(events))
    assert (first.stamp_s, second.stamp_s) == (1.0, 2.0)
    np.testing.assert_array_equal(first.points, [[1, 2, 3, 4]])
    assert first.offsets_s is not None
    assert first.offsets_s.tolist() == [0.1]
    assert second.offsets_s is None
