"""KITTI-360's layout: three folder trees, and poses at the times at which the vehicle moved."""

import cv2
import numpy as np
import pytest

from model_training.importing.kinds import OpenSettings, open_recording
from model_training.importing.recording import RecordedPicture, RecordedScan
from model_training.importing.take import TakeSettings, take
from service.errors import DatasetError
from service.geometry.rigid import R_BODY_OPTICAL, inverse, rotation_z, transform_from

K = np.array([[200.0, 0, 110], [0, 200.0, 30], [0, 0, 1]])
NAME = "2013_05_28_drive_0000_sync"
#: Camera 0 before rectification, against the LiDAR; and against the inertial system, whose y points right and z down.
T_LIDAR_CAM0 = transform_from(R_BODY_OPTICAL, np.array([0.8, 0.3, -0.1]))
T_POSE_CAM0 = transform_from(np.diag([1.0, -1.0, -1.0]) @ R_BODY_OPTICAL, np.array([1.6, -0.1, -1.5]))
RECTIFIED = rotation_z(np.deg2rad(1.0))  # from camera 0 to its rectified frame
MOVED = (1, 2, 3)  # frames with a pose


def line(key, matrix):
    return f"{key}: " + " ".join(f"{x:.12e}" for x in np.asarray(matrix).reshape(-1)) + "\n"


def pose(k):
    return transform_from(rotation_z(0.1 * k) @ np.diag([1.0, -1.0, -1.0]), np.array([100.0 + 2 * k, 50.0, 116.0]))


def scan_of(k):
    """Return points on circles, with ground points, so that a map can be built."""
    angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    return np.c_[8 * np.cos(angle), 8 * np.sin(angle), np.full(40, 0.1 * k), np.full(40, 0.5)].astype(np.float32)


@pytest.fixture
def root(tmp_path):
    scans = tmp_path / "data_3d_raw" / NAME / "velodyne_points"
    (scans / "data").mkdir(parents=True)
    for k in range(5):
        scan_of(k).tofile(scans / "data" / f"{k:010d}.bin")
        dots = cv2.GaussianBlur(np.random.default_rng(k).integers(0, 256, (60, 240, 3), np.uint8), (3, 3), 0)
        for eye, picture in (("00", dots[:, :220]), ("01", dots[:, 20:])):
            folder = tmp_path / "data_2d_raw" / NAME / f"image_{eye}" / "data_rect"
            folder.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(folder / f"{k:010d}.png"), picture)
    (scans / "timestamps.txt").write_text("".join(f"2013-05-28 08:46:0{k}.500000000\n" for k in range(5)))
    calibration = tmp_path / "calibration"
    calibration.mkdir()
    P1 = np.c_[K, K @ [-0.5, 0, 0]]
    (calibration / "perspective.txt").write_text(
        "calib_time: 2013\nS_rect_00: 220 60\n"
        + line("R_rect_00", RECTIFIED)
        + line("P_rect_00", np.c_[K, np.zeros(3)])
        + line("P_rect_01", P1)
    )
    (calibration / "calib_cam_to_velo.txt").write_text(" ".join(map(str, T_LIDAR_CAM0[:3].reshape(-1))) + "\n")
    (calibration / "calib_cam_to_pose.txt").write_text(
        line("image_00", T_POSE_CAM0[:3]) + line("image_01", np.eye(4)[:3])
    )
    poses = tmp_path / "data_poses" / NAME
    poses.mkdir(parents=True)
    (poses / "poses.txt").write_text(
        "".join(f"{k} " + " ".join(f"{x:.9f}" for x in pose(k)[:3].reshape(-1)) + "\n" for k in MOVED)
    )
    return tmp_path


def opened(root, depth="sgbm", part="data_3d_raw"):
    return open_recording("kitti-360", root / part / NAME, OpenSettings(depth=depth))


def events_of(root, kind, **options):
    return [event for event in opened(root, **options).events() if isinstance(event, kind)]


@pytest.mark.parametrize("part", ["data_3d_raw", "data_2d_raw", "data_poses"])
def test_a_drive_is_found_from_its_folder_in_any_of_the_trees(root, part):
    assert opened(root, part=part).count() == 10


def test_points_are_where_the_calibration_says_in_the_picture(root):
    picture, scan = events_of(root, RecordedPicture)[0], events_of(root, RecordedScan)[0]
    T_cam0_rectified = inverse(transform_from(RECTIFIED, np.zeros(3)))
    np.testing.assert_allclose(picture.T_vehicle_camera, T_LIDAR_CAM0 @ T_cam0_rectified, atol=1e-9)
    assert (picture.camera.fx, picture.camera.cx, picture.camera.cy) == (200.0, 110.0, 30.0)
    assert picture.baseline_m == pytest.approx(0.5)
    # 20 px of disparity at 200 px and 0.5 m: 5 m
    assert np.median(picture.depth[picture.depth > 0]) == pytest.approx(5.0, rel=0.02)
    np.testing.assert_allclose(scan.points[:, :3], scan_of(0)[:, :3])  # no correction of vertical angles
    assert scan.offsets_s is not None


def test_poses_are_those_of_the_lidar_at_the_moments_that_have_one(root):
    trajectory = opened(root).trajectory()
    assert len(trajectory.stamps_s) == len(MOVED)
    T_pose_lidar = T_POSE_CAM0 @ inverse(T_LIDAR_CAM0)
    np.testing.assert_allclose(trajectory.T_map_vehicle[1], pose(2) @ T_pose_lidar, atol=1e-6)
    # the LiDAR's z axis is up
    assert trajectory.T_map_vehicle[1][2, 2] == pytest.approx(1.0, abs=1e-6)


def test_a_drive_becomes_a_dataset_without_the_frames_that_have_no_pose(root, tmp_path):
    recording = opened(root)
    summary = take(recording, recording.trajectory(), tmp_path / "out", TakeSettings())
    assert summary.scans == len(MOVED)
    assert summary.pictures == len(MOVED)


@pytest.mark.parametrize(
    ("file", "text", "told"),
    [
        ("calibration/calib_cam_to_velo.txt", "1 2 3", "12 numbers"),
        ("calibration/calib_cam_to_pose.txt", "image_03: 1 2", "image_00 is missing"),
        ("calibration/calib_cam_to_pose.txt", "image_00: " + "1 " * 12, "not a rotation"),
        ("calibration/calib_cam_to_velo.txt", "1 " * 12, "not a rotation"),
        (f"data_poses/{NAME}/poses.txt", "1 " + "2 " * 12, "line 1: not a rotation"),
        ("calibration/perspective.txt", "P_rect_00: 1", "P_rect_00"),
        (f"data_poses/{NAME}/poses.txt", "1 2 3\n", "line 1"),
        (f"data_poses/{NAME}/poses.txt", "x " + "0 " * 12, "line 1"),
    ],
)
def test_a_broken_file_is_named(root, file, text, told):
    (root / file).write_text(text)
    with pytest.raises(DatasetError, match=told) as found:
        opened(root)
    assert file.rsplit("/", maxsplit=1)[-1] in str(found.value)


def test_without_scans_or_poses(root):
    (root / "data_poses" / NAME / "poses.txt").unlink()
    assert opened(root).trajectory() is None
    (root / "data_poses" / "nowhere").mkdir()
    with pytest.raises(DatasetError, match="has no scan"):
        open_recording("kitti-360", root / "data_poses" / "nowhere", OpenSettings(depth="sgbm"))


def test_the_root_or_a_tree_names_the_drives(root):
    drive = root / "data_3d_raw" / NAME
    wanted = "expected the folder of one drive in data_3d_raw, data_2d_raw, data_poses; give"
    for source in (root, root / "data_3d_raw", root / "data_poses", drive / "velodyne_points" / "data"):
        with pytest.raises(DatasetError) as caught:
            open_recording("kitti-360", source, OpenSettings())
        assert caught.value.message == f"{source}: {wanted} this one: {drive}"


def test_depth_that_the_layout_lacks_is_refused(root):
    with pytest.raises(DatasetError, match="sgbm, lidar"):
        opened(root, depth="stored")


def test_a_link_to_a_drive_on_another_disk_is_not_followed(root, tmp_path):
    elsewhere = tmp_path / "disk" / NAME
    elsewhere.parent.mkdir()
    (root / "data_3d_raw" / NAME).rename(elsewhere)
    (root / "data_3d_raw" / NAME).symlink_to(elsewhere)
    assert opened(root).count() == 10


def test_blank_last_lines_are_no_lines(root):
    for path in (root / f"data_3d_raw/{NAME}/velodyne_points/timestamps.txt", root / f"data_poses/{NAME}/poses.txt"):
        path.write_text(path.read_text() + "\n")
    assert len(opened(root).trajectory().stamps_s) == len(MOVED)


def test_the_usual_depth_is_that_of_the_pair(root):
    assert np.median(events_of(root, RecordedPicture, depth="recorded")[0].depth) > 0


def test_without_poses_their_mounting_is_not_needed(root):
    (root / f"data_poses/{NAME}/poses.txt").unlink()
    (root / "calibration/calib_cam_to_pose.txt").unlink()
    assert opened(root).trajectory() is None


@pytest.mark.parametrize("text", ["", "\n", "99 1 0 0 0 0 1 0 0 0 0 1 0\n"])
def test_a_pose_file_without_a_pose_of_this_drive_is_none(root, text):
    (root / f"data_poses/{NAME}/poses.txt").write_text(text)
    assert opened(root).trajectory() is None


def test_a_scan_that_was_not_recorded_may_have_a_blank_line(root):
    scans = root / f"data_3d_raw/{NAME}/velodyne_points"
    lines = (scans / "timestamps.txt").read_text().splitlines()
    (scans / "data/0000000002.bin").unlink()
    for eye in ("00", "01"):
        (root / f"data_2d_raw/{NAME}/image_{eye}/data_rect/0000000002.png").unlink()
    (scans / "timestamps.txt").write_text("\n".join([*lines[:2], "", *lines[3:]]) + "\n")
    assert opened(root).count() == 8


def test_a_scan_without_a_time_is_named(root):
    path = root / f"data_3d_raw/{NAME}/velodyne_points/timestamps.txt"
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:2], "", *lines[3:]]) + "\n")
    with pytest.raises(DatasetError, match=r"timestamps.txt, line 3: not a time"):
        opened(root)
