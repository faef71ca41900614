"""Bags with missing or damaged parts, and the poses from bags."""

import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from model_training.importing.extrinsics import Extrinsics
from model_training.importing.kinds import OpenSettings, open_recording
from model_training.importing.recording import RecordedPicture, RecordedScan, Unusable
from model_training.importing.ros_bag import RosBag
from model_training.importing.ros_content import BagSettings
from service.errors import DatasetError
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import R_BODY_OPTICAL, rotation_z, transform_from

T_LIDAR = transform_from(rotation_z(0.5), np.array([1.0, 0.0, 1.8]))
T_CAMERA = transform_from(R_BODY_OPTICAL, np.array([1.5, 0.1, 1.4]))
COLOR, DEPTH = np.arange(144, dtype=np.uint8).reshape(6, 8, 3), np.full((6, 8), 1500, np.uint16)
PICTURES = {"/camera/color/image_raw", "/camera/depth/image_raw", "/camera/color/camera_info"}


def at(x):
    return transform_from(np.eye(3), np.array([float(x), 0.0, 0.0]))


@pytest.fixture
def drive(ros):
    """Return the messages of a drive with ten scans and ten image pairs; ``without`` omits topics."""

    def made(*, without=(), count=10, mountings=None):
        edges = (
            mountings if mountings is not None else [("base_link", "lidar", T_LIDAR), ("base_link", "camera", T_CAMERA)]
        )
        messages = [("/tf_static", 0.0, ros.tf(*(ros.edge(0.0, *edge) for edge in edges)))]
        for k in range(count):
            s = 0.1 * k
            messages += [
                ("/odom", s, ros.odometry(s, at(k))),
                ("/points", s, ros.cloud(s, [[k, 1, 2, 3]])),
                ("/camera/color/camera_info", s, ros.info(s)),
                ("/camera/color/image_raw", s, ros.image(s, COLOR, "rgb8")),
                ("/camera/depth/image_raw", s, ros.image(s, DEPTH, "16UC1")),
            ]
        return [message for message in messages if message[0] not in without]

    return made


def opened(path, **told):
    return RosBag(path, BagSettings(**told))


def kinds(events):
    return [type(event).__name__ for event in events]


def test_scans_and_pairs_come_with_mountings_and_poses(ros, drive, tmp_path):
    bag = opened(ros.write(tmp_path / "bag", drive()))
    events = list(bag.events())
    scans = [event for event in events if isinstance(event, RecordedScan)]
    pictures = [event for event in events if isinstance(event, RecordedPicture)]
    assert (len(scans), len(pictures), bag.count()) == (10, 10, 20)
    np.testing.assert_array_equal(scans[3].points, [[3, 1, 2, 3]])
    np.testing.assert_array_equal(pictures[9].rgb, COLOR)
    np.testing.assert_array_equal(pictures[9].depth, DEPTH)
    np.testing.assert_allclose(bag.lidar.T_vehicle_sensor, T_LIDAR, atol=1e-12)
    np.testing.assert_allclose(pictures[0].T_vehicle_camera, T_CAMERA, atol=1e-12)
    np.testing.assert_allclose(bag.trajectory().T_map_vehicle[:, 0, 3], np.arange(10))
    assert "poses are of: base_link" in bag.notes.lines
    assert not [kind for kind in kinds(bag.events(pictures=False)) if kind != "RecordedScan"]


@pytest.mark.parametrize(("storage", "suffix"), [("mcap", "*.mcap"), ("sqlite3", "*.db3")])
def test_a_bags_file_alone_is_as_good_as_its_folder(ros, drive, tmp_path, storage, suffix):
    folder = ros.write(tmp_path / "bag", drive(count=3), storage=storage)
    (file,) = folder.glob(suffix)
    alone, whole = opened(file), opened(folder)
    assert kinds(alone.events()) == kinds(whole.events())
    assert alone.notes.lines == whole.notes.lines


def test_a_bag_without_a_topic_of_depth_says_what_serves_its_pictures(ros, drive, tmp_path):
    path = ros.write(tmp_path / "bag", drive(without={"/camera/depth/image_raw"}, count=2))
    (line,) = opened(path).notes.picture_lines
    assert line == (
        "no depth topic, so no image becomes a query: give --depth lidar (depth from the scans), --depth sgbm (depth from a stereo pair), "
        "--topic depth=NAME, or --no-pictures"
    )
    assert opened(path, want_depth=False).notes.picture_lines == ()


RIGHT = "/camera/right/camera_info"


def with_right_info(ros, drive, shift):
    """Return the drive with the calibration of a right camera: fx is 8 px, and P[0, 3] the given shift."""
    message = ros.info(0.0)
    message.p[3] = shift
    return [*drive(count=2), (RIGHT, 0.2, message)]


@pytest.mark.parametrize(
    ("told", "baseline_m"),
    [({"topics": {"right_info": RIGHT}}, 0.12), ({"baseline_m": 0.3}, 0.3), ({}, None)],
)
def test_the_depth_of_a_stereo_rig_carries_its_baseline(ros, drive, tmp_path, told, baseline_m):
    bag = opened(ros.write(tmp_path / "bag", with_right_info(ros, drive, -0.96)), **told)  # 0.96 px m / 8 px = 0.12 m
    pictures = [event for event in bag.events() if isinstance(event, RecordedPicture)]
    assert [picture.baseline_m for picture in pictures] == [pytest.approx(baseline_m)] * 2
    hints = bag.notes.picture_lines
    assert len(hints) == (baseline_m is None)
    assert all("--baseline-m METRES, or its right CameraInfo with --topic right_info=NAME;" in hint for hint in hints)
    assert bag.notes.source["topics"]["right_info"] == (RIGHT if "topics" in told else None)


def test_a_left_calibration_gives_no_baseline_and_is_named(ros, drive, tmp_path):
    path = ros.write(tmp_path / "bag", with_right_info(ros, drive, 0.0))
    with pytest.raises(
        DatasetError, match=rf"bag, topic {RIGHT}: .*mean a baseline of 0 m.*name the CameraInfo of the rectified right"
    ):
        opened(path, topics={"right_info": RIGHT})


def test_the_depth_of_scans_has_no_baseline(ros, drive, tmp_path):
    path = ros.write(tmp_path / "bag", drive(count=2))
    bag = opened(path, want_depth=False)
    assert bag.notes.picture_lines == ()
    assert [event.baseline_m for event in bag.events() if isinstance(event, RecordedPicture)] == [None, None]


def test_a_bag_without_a_point_cloud_is_refused(ros, drive, tmp_path):
    with pytest.raises(DatasetError, match="bag has no sensor_msgs/PointCloud2"):
        opened(ros.write(tmp_path / "bag", drive(without={"/points"})))


def test_pictures_without_camera_info_need_a_camera_or_to_be_left_out(ros, drive, tmp_path):
    path = ros.write(tmp_path / "bag", drive(without={"/camera/color/camera_info"}))
    with pytest.raises(DatasetError, match=r"image_raw has no sensor_msgs/CameraInfo.*--camera FILE.*--no-pictures"):
        opened(path)
    camera = PinholeCamera(8, 6, 9.0, 9.0, 4.0, 3.0)
    (picture, *_) = [e for e in opened(path, camera=camera).events() if isinstance(e, RecordedPicture)]
    assert picture.camera == camera
    np.testing.assert_allclose(picture.T_vehicle_camera, T_CAMERA, atol=1e-12)
    without = open_recording("rosbag", path, OpenSettings(pictures=False))
    assert set(kinds(without.events())) == {"RecordedScan"}


def test_an_uncalibrated_camera_is_named_with_its_topic(ros, drive, tmp_path):
    messages = [m if m[0] != "/camera/color/camera_info" else (m[0], m[1], ros.info(m[1], focal=0.0)) for m in drive()]
    with pytest.raises(DatasetError, match=r"topic /camera/color/camera_info: .*not calibrated"):
        opened(ros.write(tmp_path / "bag", messages))


def test_without_poses_there_is_no_trajectory_and_the_lidar_is_the_vehicle(ros, drive, tmp_path):
    bag = opened(ros.write(tmp_path / "bag", drive(without={"/odom"})))
    assert bag.trajectory() is None
    assert bag.lidar.T_vehicle_sensor == np.eye(4).tolist()


def test_a_missing_mounting_is_named_and_can_be_given(ros, drive, tmp_path):
    path = ros.write(tmp_path / "bag", drive(mountings=[("base_link", "lidar", T_LIDAR)]))
    with pytest.raises(
        DatasetError, match=r"no transform from 'lidar' to 'camera'; give T_vehicle_camera .*--extrinsics"
    ):
        opened(path)
    (picture, *_) = [
        e
        for e in opened(path, extrinsics=Extrinsics(T_vehicle_camera=T_CAMERA)).events()
        if isinstance(e, RecordedPicture)
    ]
    np.testing.assert_allclose(picture.T_vehicle_camera, T_CAMERA)
    path = ros.write(tmp_path / "none", drive(mountings=[], without=PICTURES))
    with pytest.raises(DatasetError, match="no transform from 'base_link' to 'lidar'; give T_vehicle_lidar"):
        opened(path)


def test_a_camera_mounted_on_the_lidar_uses_the_given_mounting_of_the_lidar(ros, drive, tmp_path):
    T_lidar_camera = np.linalg.inv(T_LIDAR) @ T_CAMERA
    path = ros.write(tmp_path / "bag", drive(mountings=[("lidar", "camera", T_lidar_camera)]))
    bag = opened(path, extrinsics=Extrinsics(T_vehicle_lidar=T_LIDAR))
    (picture, *_) = [e for e in bag.events() if isinstance(e, RecordedPicture)]
    np.testing.assert_allclose(picture.T_vehicle_camera, T_CAMERA, atol=1e-12)


def with_poses(ros, drive, message_of):
    """Return the drive with poses other than those of the odometry."""
    extra = [(topic, 0.1 * k, message) for k in range(10) for topic, message in [message_of(k, 0.1 * k)]]
    messages = [*drive(without={"/odom", *PICTURES}), *extra]
    return sorted(messages, key=lambda message: message[1])


def test_stamped_poses_are_taken_as_lidar_poses_and_a_line_says_so(ros, drive, tmp_path):
    messages = with_poses(ros, drive, lambda k, s: ("/pose", ros.pose_stamped(s, at(k))))
    bag = opened(ros.write(tmp_path / "bag", messages))
    assert "poses are of: the LiDAR (assumed: the topic does not say)" in bag.notes.lines
    assert bag.lidar.T_vehicle_sensor == np.eye(4).tolist()
    told = opened(tmp_path / "bag", extrinsics=Extrinsics(T_vehicle_lidar=T_LIDAR))
    assert "poses are of: the vehicle of --extrinsics (assumed: the topic does not say)" in told.notes.lines
    np.testing.assert_allclose(told.lidar.T_vehicle_sensor, T_LIDAR)


def test_poses_from_tf_are_those_of_the_lidar_also_with_a_given_mounting(ros, drive, tmp_path):
    messages = with_poses(ros, drive, lambda k, s: ("/tf", ros.tf(ros.edge(s, "odom", "base_link", at(k)))))
    path = ros.write(tmp_path / "bag", messages)
    for told in (Extrinsics(), Extrinsics(T_vehicle_lidar=at(3))):
        bag = opened(path, extrinsics=told)
        T_map_lidar = bag.trajectory().T_map_vehicle @ np.array(bag.lidar.T_vehicle_sensor)
        np.testing.assert_allclose(T_map_lidar, np.stack([at(k) @ T_LIDAR for k in range(10)]), atol=1e-9)


def test_a_lidar_missing_in_tf_uses_the_given_mounting(ros, drive, tmp_path):
    messages = with_poses(ros, drive, lambda k, s: ("/tf", ros.tf(ros.edge(s, "odom", "base_link", at(k)))))
    path = ros.write(tmp_path / "bag", [m for m in messages if m[0] != "/tf_static"])
    assert opened(path).trajectory() is None
    bag = opened(path, extrinsics=Extrinsics(T_vehicle_lidar=T_LIDAR))
    np.testing.assert_allclose(bag.trajectory().T_map_vehicle[:, 0, 3], np.arange(10))
    np.testing.assert_allclose(bag.lidar.T_vehicle_sensor, T_LIDAR)


def test_poses_that_are_none_are_left_out_and_counted(ros, drive, tmp_path):
    messages = with_poses(ros, drive, lambda k, s: ("/odom", ros.odometry(s, at(np.nan if k == 2 else k))))
    messages.append(("/odom", 2.0, ros.odometry(0.5, at(99))))
    bag = opened(ros.write(tmp_path / "bag", messages))
    assert bag.trajectory().T_map_vehicle[:, 0, 3].tolist() == [0, 1, 3, 4, 5, 6, 7, 8, 9]
    assert "poses: 2 left out: not finite, or not later than the pose before" in bag.notes.lines


def test_a_message_that_is_none_is_counted_and_the_others_are_kept(ros, drive, tmp_path):
    messages = drive(count=4, without=PICTURES)
    messages.insert(6, ("/points", 0.15, b"\x00\x01\x00\x00rubbish"))
    found = list(opened(ros.write(tmp_path / "bag", messages)).events())
    assert kinds(found).count("RecordedScan") == 4
    (bad,) = [event for event in found if isinstance(event, Unusable)]
    assert (bad.kind, bad.name) == ("scan", "/points")
    assert "not a valid sensor_msgs/msg/PointCloud2" in bad.why


def test_pictures_of_mixed_sizes_and_encodings_are_counted(ros, drive, tmp_path):
    messages = drive(count=4)
    odd = {0.1: ros.image(0.1, COLOR[:4], "rgb8"), 0.2: ros.image(0.2, COLOR, "yuv422")}
    messages = [
        (t, s, odd.get(round(s, 1), m)) if t == "/camera/color/image_raw" else (t, s, m) for t, s, m in messages
    ]
    messages = [m for m in messages if m[:2] != ("/camera/depth/image_raw", messages[-1][1])]
    found = list(opened(ros.write(tmp_path / "bag", messages)).events())
    bad = [event for event in found if isinstance(event, Unusable)]
    assert kinds(found).count("RecordedPicture") == 1
    assert [b.why.split(" (")[0].split(":")[0] for b in bad] == [
        "sizes differ",
        "unknown encoding 'yuv422'",
        "no depth within 0.02 s of it",
    ]
    assert [b.name for b in bad] == [*(f"/camera/color/image_raw at {s:.6f}" for s in (0.1, 0.2)), "color at 0.300000"]


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
@pytest.mark.parametrize("share", [0.0, 0.02, 0.5, 0.9, 0.999])
def test_a_bag_that_was_cut_off_gives_its_good_frames_or_the_remedy(ros, drive, tmp_path, storage, share):
    folder: Path = ros.write(tmp_path / "bag", drive(count=60), storage=storage)
    (file,) = folder.glob("*.[md][cb]*")
    data = file.read_bytes()
    file.write_bytes(data[: int(share * len(data))])
    try:
        bag = opened(file)
    except DatasetError as error:
        told = error.message
        remedies = ("mcap recover", "no sensor_msgs/PointCloud2")
        if not any(remedy in told for remedy in remedies):
            pytest.fail(f"no remedy in: {told}")
        return
    found = list(bag.events())
    whole = kinds(found).count("RecordedScan") == 60  # nothing but an index was lost
    assert whole or "Unusable" in kinds(found)
    assert "RecordedScan" in kinds(found)


def test_damage_in_the_middle_keeps_what_came_before(ros, drive, tmp_path):
    big = np.random.default_rng(0).normal(size=(2000, 4))
    messages = [(t, s, ros.cloud(s, big) if t == "/points" else m) for t, s, m in drive(count=150, without=PICTURES)]
    (file,) = ros.write(tmp_path / "bag", messages).glob("*.mcap")
    data = bytearray(file.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 70_000] = b"\xa5" * 70_000  # more than a scan: no length in it makes sense
    file.write_bytes(data)
    bag = opened(file)
    found = list(bag.events())
    assert any("poses: reading stopped here" in line for line in bag.notes.lines)
    assert 20 < kinds(found).count("RecordedScan") < 150
    assert isinstance(found[-1], Unusable)
    assert (found[-1].kind, found[-1].name) == ("bag", file.name)


@pytest.mark.parametrize("name", ["drive.mcap", "drive.db3", "drive.bag", "drive.txt"])
def test_a_file_that_is_no_bag_is_refused_with_its_name(tmp_path, name):
    (tmp_path / name).write_bytes(b"no bag at all" * 100)
    with pytest.raises(DatasetError, match=f"{name}: cannot be opened as a ROS bag"):
        opened(tmp_path / name)


@pytest.mark.parametrize(
    ("files", "remedy"),
    [
        ((), r"give the folder of the bag, or a file that ends in \.bag, \.mcap, \.db3$"),
        (("b.mcap", "a.bag", "notes.txt"), r"give the file of the bag: \S*/a\.bag, \S*/b\.mcap$"),
        (
            ("monday/metadata.yaml", "monday/a.mcap", "friday/metadata.yaml"),
            r"give the folder of the bag: \S*/friday, \S*/monday$",
        ),
    ],
)
def test_a_folder_without_metadata_is_refused_with_the_bags_in_it(tmp_path, files, remedy):
    for name in files:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    with pytest.raises(DatasetError, match=f"{tmp_path} has no metadata.yaml; {remedy}"):
        opened(tmp_path)


def test_memory_does_not_grow_with_the_scans(ros, tmp_path):
    points = np.zeros((400, 4))

    def peak(count):
        messages = [("/points", 0.1 * k, ros.cloud(0.1 * k, points)) for k in range(count)]
        path = ros.write(tmp_path / str(count), messages, storage="sqlite3")
        tracemalloc.start()
        assert sum(isinstance(event, RecordedScan) for event in opened(path).events()) == count
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return most

    peak(2)  # what is loaded once
    assert peak(150) - peak(50) < 20 * points.size * 4  # of 100 more scans
