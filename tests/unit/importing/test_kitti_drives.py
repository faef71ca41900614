"""KITTI's raw and odometry layouts: scans, pairs, calibration, times and poses, and errors for damaged files."""

from typing import Any

import cv2
import numpy as np
import pytest

from model_training.datasets.dataset import Dataset
from model_training.datasets.layouts import SCANS_AT_REST
from model_training.importing.kinds import OpenSettings, open_recording
from model_training.importing.oxts import read_oxts
from model_training.importing.recording import RecordedPicture, RecordedScan, Unusable
from model_training.importing.spinning import KITTI_VERTICAL_DEG, raised
from model_training.importing.take import TakeSettings, take
from service.errors import DatasetError
from service.geometry.rigid import R_BODY_OPTICAL, rotation_z

K = np.array([[200.0, 0, 110], [0, 200.0, 30], [0, 0, 1]])
BASELINE_M = 0.5
T_CAM_VELO = np.c_[R_BODY_OPTICAL.T, [0.01, -0.08, -0.27]]


def line(key, matrix):
    return f"{key}: " + " ".join(f"{x:.12e}" for x in np.asarray(matrix).reshape(-1)) + "\n"


def projection(x):
    return np.c_[K, K @ [x, 0, 0]]


def write_pictures(left, right, stored, name, seed):
    """Write images of a wall 5 m ahead."""
    dots = cv2.GaussianBlur(np.random.default_rng(seed).integers(0, 256, (60, 240, 3), np.uint8), (3, 3), 0)
    for folder, picture in (
        (left, dots[:, :220]),
        (right, dots[:, 20:]),
        (stored, np.full((60, 220), 5 * 256, np.uint16)),
    ):
        folder.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(folder / f"{name}.png"), picture)


def scan_of(k):
    return np.array([[5, k, 0, 0.5], [6, 1, 1, 0.25]], np.float32)


OXTS = [
    (49.0, 8.4, 110.0, 0.01, 0.02, 0.5),
    (49.0001, 8.4002, 110.5, 0.0, 0.0, 0.6),
    (49.0002, 8.4003, 111.0, 0.0, 0.0, 0.7),
]


@pytest.fixture
def raw(tmp_path):
    """Write three frames of a drive, at 0.1, 0.2 and 0.3 s after the hour."""
    day = tmp_path / "2011_09_26"
    drive = day / "2011_09_26_drive_0005_sync"
    (drive / "velodyne_points" / "data").mkdir(parents=True)
    (drive / "oxts" / "data").mkdir(parents=True)
    for k in range(3):
        name = f"{k:010d}"
        scan_of(k).tofile(drive / "velodyne_points" / "data" / f"{name}.bin")
        stored = drive / "proj_depth" / "groundtruth" / "image_02"
        write_pictures(drive / "image_02" / "data", drive / "image_03" / "data", stored, name, k)
        (drive / "oxts" / "data" / f"{name}.txt").write_text(" ".join(map(str, (*OXTS[k], *[0.0] * 24))))
    for sensor in ("velodyne_points", "oxts"):
        times = "".join(f"2011-09-26 13:00:00.{k}00000000\n" for k in range(3))
        (drive / sensor / "timestamps.txt").write_text(times)
    (day / "calib_velo_to_cam.txt").write_text(
        "calib_time: 15-Mar-2012\n" + line("R", T_CAM_VELO[:, :3]) + line("T", T_CAM_VELO[:, 3])
    )
    (day / "calib_cam_to_cam.txt").write_text(
        line("R_rect_00", np.eye(3))
        + line("P_rect_02", projection(0.06))
        + line("P_rect_03", projection(0.06 - BASELINE_M))
    )
    (day / "calib_imu_to_velo.txt").write_text(line("R", np.eye(3)) + line("T", [-0.8, 0.3, -0.8]))
    return drive


@pytest.fixture
def odometry(tmp_path):
    sequence = tmp_path / "dataset" / "sequences" / "07"
    (sequence / "velodyne").mkdir(parents=True)
    for k in range(3):
        scan_of(k).tofile(sequence / "velodyne" / f"{k:06d}.bin")
        write_pictures(sequence / "image_2", sequence / "image_3", sequence / "depth_2", f"{k:06d}", k)
    calibration = line("P2", projection(0.06)) + line("P3", projection(0.06 - BASELINE_M)) + line("Tr", T_CAM_VELO)
    (sequence / "calib.txt").write_text(calibration)
    (sequence / "times.txt").write_text("0.0\n1.036e-01\n2.073e-01\n")
    (tmp_path / "dataset" / "poses").mkdir()
    ahead = "".join(" ".join(map(str, np.c_[np.eye(3), [0, 0, 2.0 * k]].reshape(-1))) + "\n" for k in range(3))
    (tmp_path / "dataset" / "poses" / "07.txt").write_text(ahead)
    return sequence


def opened(path, depth="recorded"):
    return open_recording("kitti-raw" if "sync" in path.name else "kitti-odometry", path, OpenSettings(depth=depth))


@pytest.fixture(params=["raw", "odometry"])
def drive(request):
    return request.getfixturevalue(request.param)


def events_of(path, kind, depth="recorded"):
    return [event for event in opened(path, depth).events() if isinstance(event, kind)]


def test_scans_and_pictures_come_with_the_mounting_of_the_calibration(drive):
    scans, pictures = events_of(drive, RecordedScan), events_of(drive, RecordedPicture)
    np.testing.assert_allclose(scans[2].points, raised(scan_of(2), KITTI_VERTICAL_DEG))
    assert [p.stamp_s for p in pictures] == [s.stamp_s for s in scans]
    assert opened(drive).count() == 6
    picture = pictures[0]
    points = np.c_[scan_of(1)[:, :3], [1, 1]]
    expected = projection(0.06) @ np.vstack([T_CAM_VELO @ points.T, [1, 1]])
    seen = (np.linalg.inv(picture.T_vehicle_camera) @ points.T)[:3]
    np.testing.assert_allclose(picture.camera.matrix @ seen, expected, atol=1e-9)
    np.testing.assert_allclose(picture.depth * picture.depth_scale_m, 5.0)
    assert picture.file.name.startswith("0000")


def only_grey(drive):
    """Write the same images with one channel, from cameras 0 and 1. Camera 0 has no offset."""
    raw = "sync" in drive.name
    for colour, grey in (("2", "0"), ("3", "1")):
        folder = drive / (f"image_0{colour}" if raw else f"image_{colour}")
        for path in folder.rglob("*.png"):
            picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
            assert picture is not None
            cv2.imwrite(str(path), picture)
        folder.rename(drive / (f"image_0{grey}" if raw else f"image_{grey}"))
    calibration = drive.parent / "calib_cam_to_cam.txt" if raw else drive / "calib.txt"
    names = ("P_rect_00", "P_rect_01") if raw else ("P0", "P1")
    calibration.write_text(
        calibration.read_text() + line(names[0], projection(0.0)) + line(names[1], projection(-BASELINE_M))
    )


def test_where_there_is_no_colour_pair_the_grey_one_is_taken(drive):
    colour = events_of(drive, RecordedPicture, "sgbm")[0]
    only_grey(drive)
    grey = events_of(drive, RecordedPicture, "sgbm")[0]
    depth = grey.depth[:, 140:]
    assert abs(np.median(depth[depth > 0]) - 5.0) < 0.02
    assert grey.baseline_m == pytest.approx(BASELINE_M)
    moved = grey.T_vehicle_camera[:3, 3] - colour.T_vehicle_camera[:3, 3]
    assert np.linalg.norm(moved) == pytest.approx(0.06)  # camera 2 stands that far aside of camera 0


def test_matched_depth_is_that_of_the_wall(drive):
    depth = events_of(drive, RecordedPicture, "sgbm")[0].depth[:, 140:]
    assert abs(np.median(depth[depth > 0]) - 5.0) < 0.02


def lower_the_right_images(drive, rows):
    """Move what the right images show down by some rows, as a turned right camera does."""
    for folder in ("image_3", "image_03/data"):
        for path in (drive / folder).glob("*.png"):
            picture = cv2.imread(str(path))
            assert picture is not None
            cv2.imwrite(str(path), np.roll(picture, rows, axis=0))


def test_the_rows_of_the_pairs_are_aligned(drive, tmp_path):
    """One row at a focal length of 200 px is a pitch of 1 / 200 rad = 0.286 degrees."""
    lower_the_right_images(drive, 1)
    recording = opened(drive, "sgbm")
    assert any("0.28" in text and "degrees of pitch" in text for text in recording.notes.lines)
    take(recording, recording.trajectory(), tmp_path / "taken", TakeSettings())
    dataset = Dataset(tmp_path / "taken")
    assert dataset.description.source["row_alignment"]["pitch_rad"] == pytest.approx(1 / 200, rel=0.02)
    depth = events_of(drive, RecordedPicture, "sgbm")[0].depth[5:-5, 140:]
    assert (np.abs(depth - 5.0) < 0.05).mean() > 0.9


def test_pairs_that_cannot_be_read_do_not_prevent_the_alignment(drive):
    lower_the_right_images(drive, 1)
    for path in [*drive.glob("image_2/*1.png"), *drive.glob("image_02/data/*1.png")]:
        path.write_bytes(b"no image")
    source = opened(drive, "sgbm").notes.source
    assert source["row_alignment"]["pitch_rad"] == pytest.approx(1 / 200, rel=0.02)


def test_rows_are_measured_only_for_matching(drive):
    kind = "kitti-raw" if (drive / "velodyne_points").is_dir() else "kitti-odometry"
    without_pictures = open_recording(kind, drive, OpenSettings(depth="sgbm", pictures=False))
    for recording in (without_pictures, opened(drive, "stored")):
        assert "row_alignment" not in recording.notes.source
    assert "row_alignment" in opened(drive, "sgbm").notes.source


@pytest.mark.parametrize(("depth", "baseline_m"), [("sgbm", BASELINE_M), ("stored", None)])
def test_only_matched_depth_has_a_baseline(drive, depth, baseline_m, tmp_path):
    recording = opened(drive, depth)
    assert [p.baseline_m for p in events_of(drive, RecordedPicture, depth)] == [pytest.approx(baseline_m)] * 3
    take(recording, recording.trajectory(), tmp_path / "taken", TakeSettings())
    (camera,) = Dataset(tmp_path / "taken").description.sensors.cameras
    assert camera.depth.baseline_m == pytest.approx(baseline_m)


def test_the_depth_of_scans_is_left_to_the_importer(drive):
    assert events_of(drive, RecordedPicture, "lidar")[0].depth is None


def test_frames_that_lack_a_picture_or_a_whole_scan_are_counted(drive):
    for folder in ("image_3", "image_03/data"):
        for path in (drive / folder).glob("*1.png"):
            path.unlink()
    (scan,) = drive.glob("velodyne*/**/*2.bin")
    scan.write_bytes(scan.read_bytes()[:-1])
    bad = events_of(drive, Unusable, "sgbm")
    without_right = (
        "no right image beside it; the choices of --depth are stored (3 of 3 images have it), "
        "sgbm (2 of 3 images have a right one), lidar (3 scans)"
    )
    assert [(b.kind, b.why) for b in bad] == [
        ("image", without_right),
        ("scan", "its size is not a multiple of 16 bytes (rows of four float32): truncated"),
    ]
    assert bad[1].name.startswith("velodyne 0000")


def test_images_with_the_same_defect_are_counted_together(drive):
    for path in [*drive.glob("depth_2/*"), *drive.glob("proj_depth/groundtruth/image_02/*")]:
        path.write_bytes(path.read_bytes()[:60])
    bad = events_of(drive, Unusable, "stored")
    assert len(bad) == 3
    assert len({b.why for b in bad}) == 1


def test_stereo_without_the_right_cameras_calibration_is_refused(drive):
    for path in (drive / "calib.txt", drive.parent / "calib_cam_to_cam.txt"):
        if path.is_file():
            kept = [text for text in path.read_text().splitlines() if not text.startswith(("P3", "P_rect_03"))]
            path.write_text("\n".join(kept))
    assert len(events_of(drive, RecordedPicture, "stored")) == 3
    with pytest.raises(DatasetError, match=r"has no right camera .*--depth lidar"):
        events_of(drive, RecordedPicture, "sgbm")


def test_a_missing_calibration_is_named(drive):
    path = drive / "calib.txt" if (drive / "calib.txt").is_file() else drive.parent / "calib_velo_to_cam.txt"
    path.unlink()
    with pytest.raises(DatasetError, match=rf"{path.name} cannot be read|{path.name} not found"):
        opened(drive)


def test_times_that_end_early_or_are_none_are_named(drive):
    path = next(p for p in (drive / "times.txt", drive / "velodyne_points" / "timestamps.txt") if p.is_file())
    lines = path.read_text().splitlines()
    path.write_text("\n".join(lines[:2]) + "\n")
    with pytest.raises(DatasetError, match=rf"{path.name} has 2 (times|lines), but there is a frame 0+2"):
        opened(drive)
    path.write_text("\n".join([lines[0], "noon", lines[2]]))
    with pytest.raises(DatasetError, match=path.name):
        opened(drive)


def test_times_are_read_to_the_nanosecond_and_at_ten_hertz_without(raw, odometry):
    assert np.diff([s.stamp_s for s in events_of(raw, RecordedScan)]) == pytest.approx(0.1, abs=1e-6)
    assert [s.stamp_s for s in events_of(odometry, RecordedScan)] == [0.0, 0.1036, 0.2073]
    (raw / "velodyne_points" / "timestamps.txt").unlink()
    (odometry / "times.txt").unlink()
    for path in (raw, odometry):
        assert [s.stamp_s for s in events_of(path, RecordedScan)] == pytest.approx([0.0, 0.1, 0.2])


def test_odometrys_poses_are_of_the_lidar_in_a_level_map(odometry):
    T = opened(odometry).trajectory().T_map_vehicle
    np.testing.assert_allclose(T[:, :3, 3], [[0, 0, 0], [2, 0, 0], [4, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(T[2, :3, :3], np.eye(3), atol=1e-12)


@pytest.mark.parametrize("text", ["1 2 3\n", "a b c d e f g h i j k l\n", "nan " * 12 + "\n"])
def test_a_pose_that_is_none_is_named(odometry, text):
    path = odometry.parent.parent / "poses" / "07.txt"
    path.write_text(path.read_text().splitlines()[0] + "\n" + text)
    with pytest.raises(DatasetError, match=r"07\.txt, (line|pose) 2"):
        opened(odometry)


def test_a_recording_without_poses_says_none(raw, odometry):
    (odometry.parent.parent / "poses" / "07.txt").unlink()
    for path in (raw / "oxts" / "data").iterdir():
        path.unlink()
    assert opened(raw).trajectory() is None
    assert opened(raw).georeference is None
    assert opened(odometry).trajectory() is None


def test_the_inertial_systems_poses_are_those_of_pyproj(raw):
    pyproj = pytest.importorskip("pyproj")
    latitude, longitude, height = OXTS[0][:3]
    pipeline = pyproj.Transformer.from_pipeline(
        "+proj=pipeline +step +proj=cart +ellps=WGS84 +step +proj=topocentric +ellps=WGS84 "
        f"+lat_0={latitude} +lon_0={longitude} +h_0={height}"
    )
    expected = np.array([pipeline.transform(lon, lat, h) for lat, lon, h, *_ in OXTS])
    T_map_imu, georeference = read_oxts(sorted((raw / "oxts" / "data").iterdir()))
    np.testing.assert_allclose(T_map_imu[:, :3, 3], expected, atol=1e-4)
    assert georeference == {"latitude_deg": 49.0, "longitude_deg": 8.4, "height_m": 110.0}
    np.testing.assert_allclose(T_map_imu[1, :3, :3], rotation_z(0.6), atol=1e-12)
    assert T_map_imu[0, 2, 0] == pytest.approx(
        -np.sin(0.02)
    )  # a positive pitch is nose down, about the axis to the left
    assert T_map_imu[0, 2, 1] == pytest.approx(np.sin(0.01) * np.cos(0.02))
    of_lidar = opened(raw).trajectory().T_map_vehicle
    np.testing.assert_allclose(of_lidar[1] @ [-0.8, 0.3, -0.8, 1.0], T_map_imu[1, :, 3], atol=1e-9)
    assert opened(raw).georeference == georeference


@pytest.mark.parametrize("text", ["49.0 8.4", "", "x y z a b c", "149.0 8.4 110 0 0 0"])
def test_a_packet_that_is_none_is_named(raw, text):
    (raw / "oxts" / "data" / "0000000000.txt").write_text(text)
    with pytest.raises(DatasetError, match=r"0000000000\.txt"):
        opened(raw)


def test_the_days_folder_will_do_where_it_holds_one_drive(raw):
    assert open_recording("kitti-raw", raw.parent, OpenSettings()).count() == 6
    (raw.parent / "2011_09_26_drive_0006_sync" / "velodyne_points").mkdir(parents=True)
    with pytest.raises(DatasetError, match=r"expected the folder of one drive.*drive_0005_sync, .*drive_0006_sync"):
        open_recording("kitti-raw", raw.parent, OpenSettings())


def refusal_of(kind, source):
    with pytest.raises(DatasetError) as caught:
        open_recording(kind, source, OpenSettings())
    assert caught.value.field == "source"
    return caught.value.message


def test_a_raw_recordings_root_names_its_drives(raw):
    root, wanted = (
        raw.parent.parent,
        "expected the folder of one drive, for example 2011_09_26_drive_0005_sync with velodyne_points; give",
    )
    assert refusal_of("kitti-raw", root) == f"{root}: {wanted} this one: {raw}"
    other = root / "raw" / "2011_09_28" / "2011_09_28_drive_0001_sync"
    (other / "velodyne_points").mkdir(parents=True)
    assert refusal_of("kitti-raw", root) == f"{root}: {wanted} one of these: {raw}, {other}"
    inside = raw / "velodyne_points" / "data"
    assert refusal_of("kitti-raw", inside) == f"{inside}: {wanted} this one: {raw}"
    for number in range(20):
        (raw.parent / f"drive_{number:02d}" / "velodyne_points").mkdir(parents=True)
    told = refusal_of("kitti-raw", raw.parent)
    assert told.partition("; give ")[2].count("drive_") == 20
    assert told.endswith("drive_18 and 1 more")


def test_an_odometry_root_names_its_sequences(odometry, kitti):
    wanted = "expected the folder of one sequence, for example sequences/00 with velodyne/*.bin; give"
    for source in (odometry.parent, odometry.parent.parent, odometry / "velodyne"):
        assert refusal_of("kitti-odometry", source) == f"{source}: {wanted} this one: {odometry}"
    other = odometry.parent / "08"
    (other / "velodyne").mkdir(parents=True)
    assert (
        refusal_of("kitti-odometry", odometry.parent)
        == f"{odometry.parent}: {wanted} one of these: {odometry}, {other}"
    )
    assert "no scans found" in refusal_of("kitti-odometry", kitti.parent)  # KITTI's object layout


def test_a_drive_without_stored_depth_lists_what_serves_it(drive):
    for folder in ("depth_2", "proj_depth/groundtruth/image_02"):
        for path in (drive / folder).glob("*.png"):
            path.unlink()
    choices = "the choices of --depth are stored (0 of 3 images have it), sgbm (3 of 3 images have a right one), lidar (3 scans)"
    assert opened(drive).notes.picture_lines == (
        f"no image has stored depth, so no image becomes a query: {choices}; --no-pictures imports no images",
    )
    assert {event.why for event in events_of(drive, Unusable)} == {f"no stored depth beside it; {choices}"}
    for depth in ("sgbm", "lidar"):
        assert opened(drive, depth).notes.picture_lines == ()


def test_a_drive_with_one_camera_says_that_stereo_does_not_serve_it(drive):
    for folder in ("image_3", "image_03/data", "depth_2", "proj_depth/groundtruth/image_02"):
        for path in (drive / folder).glob("*.png"):
            path.unlink()
    (line,) = opened(drive, "sgbm").notes.picture_lines
    assert line.startswith("no image has a right image, so no image becomes a query: ")
    assert "sgbm (0 of 3 images have a right one), lidar (3 scans)" in line
    for file in (drive / "calib.txt", drive.parent / "calib_cam_to_cam.txt"):
        if file.is_file():
            file.write_text(
                "".join(row for row in file.read_text().splitlines(True) if not row.startswith(("P3", "P_rect_03")))
            )
    (line,) = opened(drive).notes.picture_lines
    assert "sgbm (not possible: the calibration lacks the right camera)" in line


def test_a_drive_with_depth_has_no_line_about_it(drive):
    assert opened(drive).notes.picture_lines == ()


@pytest.mark.parametrize(("kind", "why"), [("kitti-raw", "no drives found"), ("kitti-odometry", "no scans found")])
def test_a_folder_of_something_else_is_refused(tmp_path, kind, why):
    with pytest.raises(DatasetError, match=why):
        open_recording(kind, tmp_path, OpenSettings())


def test_a_scan_that_vanishes_during_an_import_is_an_error_and_a_picture_is_left_out(raw):
    recording: Any = open_recording("kitti-raw", raw, OpenSettings(depth="stored"))
    events = recording.events()
    assert [type(next(events)) for _ in range(2)] == [RecordedScan, RecordedPicture]
    frame = recording.frames[1]
    frame.left.unlink()
    assert isinstance(next(events), RecordedScan)
    left_out = next(events)
    assert isinstance(left_out, Unusable)
    assert "the file is missing, or was removed" in left_out.why
    recording.frames[2].scan.unlink()
    with pytest.raises(DatasetError, match=r"0000000002\.bin: the file is missing, or was removed"):
        next(events)


def test_points_of_a_raw_drive_have_times_by_azimuth_and_those_of_a_sequence_have_none(drive):
    """A turn takes 0.1 s. It begins at the rear, and the front is at the stamp."""
    offsets = events_of(drive, RecordedScan)[1].offsets_s
    if "sync" not in drive.name:  # KITTI's odometry scans are compensated already
        assert offsets is None
        return
    azimuth = np.arctan2(scan_of(1)[:, 1], scan_of(1)[:, 0])
    np.testing.assert_allclose(offsets, -azimuth / (2 * np.pi) * 0.1, atol=1e-9)


def test_the_vertical_correction_can_be_left_out(drive):
    kind = "kitti-raw" if "sync" in drive.name else "kitti-odometry"
    recording = open_recording(kind, drive, OpenSettings(vertical_correction=False))
    scan = next(event for event in recording.events() if isinstance(event, RecordedScan))
    np.testing.assert_array_equal(scan.points, scan_of(0))
    assert recording.notes.source["vertical_correction_deg"] == 0.0
    assert opened(drive).notes.source["vertical_correction_deg"] == KITTI_VERTICAL_DEG


def test_the_dataset_says_what_was_done_to_its_scans(drive, tmp_path):
    recording = opened(drive)
    summary = take(recording, recording.trajectory(), tmp_path / "taken", TakeSettings())
    source = Dataset(tmp_path / "taken").description.source
    raw = "sync" in drive.name
    assert source["scans_deskewed"] == summary.deskewed == (3 if raw else 0)
    assert source["point_times"] == ("azimuth" if raw else "none")


def test_a_drive_that_we_wrote_is_left_as_it_is(raw):
    (raw / SCANS_AT_REST).write_text("")
    scan = events_of(raw, RecordedScan)[1]
    assert scan.offsets_s is None
    np.testing.assert_array_equal(scan.points, scan_of(1))


@pytest.mark.parametrize("place", [".", "calib", "../calib"])
def test_the_calibration_may_lie_inside_the_drive_or_in_a_folder_of_its_own(raw, place):
    expected = opened(raw).calibration
    (raw / place).mkdir(exist_ok=True)
    for path in list(raw.parent.glob("calib_*.txt")):
        path.rename(raw / place / path.name)
    found = opened(raw)
    np.testing.assert_array_equal(found.calibration.T_camera_lidar, expected.T_camera_lidar)
    assert found.trajectory() is not None
