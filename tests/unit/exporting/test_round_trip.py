"""A dataset that is written in another format and imported again."""

from functools import partial

import numpy as np
import pytest

from model_training.datasets.dataset import Dataset
from model_training.exporting.kitti_raw import DAY, DRIVE, POSES, write_kitti_raw
from model_training.exporting.moments import moments, single_camera
from model_training.exporting.ros_bag import write_bag
from model_training.importing.kinds import OpenSettings, open_recording
from model_training.importing.pose_file import read_pose_file
from model_training.importing.take import TakeSettings, take
from service.errors import DatasetError

SUFFIX = {"mcap": "", "sqlite3": "", "bag": ".bag"}


def quiet(*_):
    pass


def taken_again(kind, path, out, *, depth="recorded", poses=None):
    recording = open_recording(kind, path, OpenSettings(depth=depth))
    trajectory = recording.trajectory() if poses is None else read_pose_file(poses)
    assert trajectory is not None
    summary = take(recording, trajectory, out, TakeSettings(queries="drive"))
    assert summary.dropped == ()
    return Dataset(out)


def assert_same(before, again, *, depth_step_m):
    before_s, T_before = before.survey_trajectory()
    again_s, T_again = again.survey_trajectory()
    np.testing.assert_allclose(again_s, before_s, atol=2e-6)
    np.testing.assert_allclose(T_again, T_before, atol=1e-7)
    for k in range(len(before_s)):
        np.testing.assert_array_equal(again.scan(k), before.scan(k))
    pairs = list(zip(before.queries("drive"), again.queries("drive"), strict=True))
    assert len(pairs) == 3
    for one, two in pairs:
        np.testing.assert_array_equal(two.rgb(), one.rgb())
        np.testing.assert_allclose(two.depth_m(), one.depth_m(), atol=depth_step_m / 2 + 1e-5)
        np.testing.assert_allclose(two.T_map_camera, one.T_map_camera, atol=1e-7)
        assert (two.camera.fx, two.camera.fy, two.camera.cx, two.camera.cy) == (7.5, 7.25, 3.5, 2.75)


@pytest.mark.parametrize("kind", SUFFIX)
@pytest.mark.parametrize(("scale_m", "step_m"), [(0.001, 0.0), (1 / 1024, 0.001)])
def test_a_bag_gives_the_dataset_back(dataset_in, tmp_path, kind, scale_m, step_m):
    before = dataset_in(tmp_path / "before", scale_m=scale_m)
    path = tmp_path / f"drive{SUFFIX[kind]}"
    told = []
    assert write_bag(before, "drive", path, kind=kind, report=lambda *each: told.append(each)) == 7
    assert told == [(k, 7) for k in range(1, 8)]
    again = taken_again("rosbag", path, tmp_path / "again")
    assert_same(before, again, depth_step_m=step_m)
    mounted = np.array(again.description.sensors.lidars[0].T_vehicle_sensor)
    np.testing.assert_allclose(mounted, before.description.sensors.lidars[0].T_vehicle_sensor, atol=1e-9)


def test_kittis_raw_layout_gives_the_dataset_back(dataset, tmp_path):
    assert write_kitti_raw(dataset, "drive", tmp_path / "kitti", report=quiet) == 7
    drive = tmp_path / "kitti" / DAY / DRIVE
    again = taken_again("kitti-raw", drive, tmp_path / "again", depth="stored", poses=drive / POSES)
    assert_same(dataset, again, depth_step_m=1 / 256)


def test_the_files_of_a_ros_2_bag_are_named_after_it_and_nothing_is_left_beside(dataset, tmp_path):
    write_bag(dataset, "drive", tmp_path / "there" / "town.bag2", kind="mcap", report=quiet)
    assert sorted(p.name for p in (tmp_path / "there" / "town.bag2").iterdir()) == ["metadata.yaml", "town.bag2.mcap"]
    assert [p.name for p in (tmp_path / "there").iterdir()] == ["town.bag2"]


def test_a_survey_alone_is_written_without_pictures(dataset_in, tmp_path):
    before = dataset_in(tmp_path / "before", queries=False)
    write_bag(before, None, tmp_path / "drive", kind="mcap", report=quiet)
    again = taken_again("rosbag", tmp_path / "drive", tmp_path / "again")
    assert again.query_sets() == []
    np.testing.assert_array_equal(again.scan(3), before.scan(3))
    write_kitti_raw(before, None, tmp_path / "kitti", report=quiet)
    drive = tmp_path / "kitti" / DAY / DRIVE
    again = taken_again("kitti-raw", drive, tmp_path / "and again", poses=drive / POSES)
    np.testing.assert_allclose(again.survey_poses(), before.survey_poses(), atol=1e-7)


def test_pictures_come_after_the_survey_in_time(dataset):
    stamps = [moment.stamp_s for moment in moments(dataset, "drive")]
    assert stamps == sorted(stamps)
    assert stamps[4] - stamps[3] == pytest.approx(10.0)
    assert [moment.frame is None for moment in moments(dataset, "drive")] == [True] * 4 + [False] * 3


def test_existing_output_is_not_changed(dataset, tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "file").write_text("keep")
    for write in (
        lambda: write_bag(dataset, None, tmp_path / "mine", kind="mcap", report=quiet),
        lambda: write_kitti_raw(dataset, None, tmp_path / "mine", report=quiet),
    ):
        with pytest.raises(DatasetError, match="choose another"):
            write()
    assert [p.name for p in (tmp_path / "mine").iterdir()] == ["file"]


@pytest.mark.parametrize("kind", ["mcap", "bag", "kitti-raw"])
@pytest.mark.parametrize("end", [KeyboardInterrupt, OSError])
def test_a_run_that_ends_early_leaves_nothing(dataset, tmp_path, kind, end):
    def stop(done, total):
        if done == 3:
            raise end("enough")

    out = tmp_path / "out" / "drive"
    write = write_kitti_raw if kind == "kitti-raw" else partial(write_bag, kind=kind)
    with pytest.raises(end):
        write(dataset, "drive", out, report=stop)
    assert list((tmp_path / "out").iterdir()) == []


def test_pictures_without_truth_are_no_part_of_a_drive(dataset, tmp_path):
    (dataset.folder / "queries" / "drive" / "poses.txt").unlink()
    with pytest.raises(DatasetError, match=r"query set 'drive' has no poses.txt"):
        write_bag(dataset, "drive", tmp_path / "drive", kind="mcap", report=quiet)


def test_pictures_of_several_cameras_are_refused_by_name(dataset, tmp_path):
    described = dataset.description
    rear = described.sensors.cameras[0].model_copy(update={"name": "rear"})
    sensors = described.sensors.model_copy(update={"cameras": [*described.sensors.cameras, rear]})
    (dataset.folder / "dataset.json").write_text(described.model_copy(update={"sensors": sensors}).model_dump_json())
    (dataset.folder / "queries" / "drive" / "cameras.txt").write_text("front\nrear\nfront\n")
    with pytest.raises(DatasetError, match=r"images of 2 cameras \(front, rear\)"):
        single_camera(Dataset(dataset.folder), "drive")
