from typing import Any

import numpy as np
import pytest

from model_training.importing.cloud_file import read_cloud
from model_training.importing.clouds import open_clouds
from model_training.importing.recording import RecordedScan, Unusable
from service.errors import DatasetError

POINTS = np.array([[1, 2, 3, 10], [-4.5, 5.25, 6, 20], [7, -8, 0.5, 30]], np.float32)


def write_bin(path, points=POINTS):
    points.astype(np.float32).tofile(path)


def write_pcd(path, points=POINTS):
    point_cloud = pytest.importorskip("pypcd4").PointCloud
    point_cloud.from_xyzi_points(points).save(path)


def write_ply(path, points=POINTS):
    plyfile = pytest.importorskip("plyfile")
    rows = np.array([tuple(p) for p in points], [("x", "f8"), ("y", "f8"), ("z", "f8"), ("scalar_Intensity", "f4")])
    plyfile.PlyData([plyfile.PlyElement.describe(rows, "vertex")]).write(str(path))


def write_las(path, points=POINTS):
    laspy = pytest.importorskip("laspy")
    header = laspy.LasHeader(point_format=0, version="1.2")
    header.scales, header.offsets = [0.001] * 3, points[:, :3].mean(axis=0)
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = points[:, :3].T.astype(np.float64)
    cloud.intensity = points[:, 3].astype(np.uint16)
    cloud.write(str(path))


WRITERS = {".bin": write_bin, ".pcd": write_pcd, ".ply": write_ply, ".las": write_las, ".laz": write_las}
each_format = pytest.mark.parametrize("suffix", WRITERS)


@each_format
def test_every_format_gives_the_same_points(tmp_path, suffix):
    WRITERS[suffix](tmp_path / f"0{suffix}")
    found = read_cloud(tmp_path / f"0{suffix}")
    assert not isinstance(found, str)
    np.testing.assert_allclose(found, POINTS, atol=1e-3)
    assert found.dtype == np.float32


@each_format
def test_a_file_that_is_cut_off_says_so(tmp_path, suffix):
    path = tmp_path / f"0{suffix}"
    WRITERS[suffix](path)
    path.write_bytes(path.read_bytes()[:-9])
    assert isinstance(read_cloud(path), str)
    path.write_bytes(b"")
    assert isinstance(read_cloud(path), str)


@each_format
def test_more_points_than_allowed_are_refused(tmp_path, suffix):
    WRITERS[suffix](tmp_path / f"0{suffix}")
    assert read_cloud(tmp_path / f"0{suffix}", max_points=2) == "more than 2 points"


def test_a_cloud_in_a_maps_coordinates_is_no_scan(tmp_path):
    write_las(tmp_path / "0.las", POINTS.astype(np.float64) + [458_000, 5_428_000, 100, 0])
    assert "in the frame of its LiDAR, not of a map" in read_cloud(tmp_path / "0.las")


def test_a_cloud_without_a_coordinate_names_it(tmp_path):
    header = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nend_header\n1 2\n"
    (tmp_path / "0.ply").write_text(header)
    assert read_cloud(tmp_path / "0.ply") == "its fields have no z (they are: x, y)"


def poses_text(stamps):
    return "".join(f"{s} {k} 0 0 0 0 0 1\n" for k, s in enumerate(stamps))


def test_scans_have_the_times_of_their_poses_line_by_line(tmp_path):
    for name, suffix in (("b", ".pcd"), ("a", ".bin"), ("c", ".ply")):
        WRITERS[suffix](tmp_path / f"{name}{suffix}")
    (tmp_path / "poses.txt").write_text(poses_text([5.0, 6.5, 7.0]))
    folder = open_clouds(tmp_path)
    scans: list[Any] = list(folder.events())
    assert [(scan.name, scan.stamp_s) for scan in scans] == [("a.bin", 5.0), ("b.pcd", 6.5), ("c.ply", 7.0)]
    assert all(isinstance(scan, RecordedScan) for scan in scans)
    trajectory = folder.trajectory()
    assert trajectory is not None
    assert trajectory.T_map_vehicle[:, 0, 3].tolist() == [0, 1, 2]
    assert folder.notes.lines == ("3 scans (.bin, .pcd, .ply)",)


def test_poses_of_another_place_are_line_by_line_too(tmp_path):
    scans = tmp_path / "scans"
    scans.mkdir()
    write_bin(scans / "0.bin")
    (tmp_path / "elsewhere.txt").write_text(poses_text([42.0]))
    events: list[Any] = list(open_clouds(scans, tmp_path / "elsewhere.txt").events())
    assert [scan.stamp_s for scan in events] == [42.0]


def test_scans_without_poses_are_counted_in_tenths_of_a_second(tmp_path):
    write_bin(tmp_path / "0.bin")
    write_bin(tmp_path / "1.bin")
    folder = open_clouds(tmp_path)
    assert folder.trajectory() is None
    events: list[Any] = list(folder.events())
    assert [scan.stamp_s for scan in events] == [0.0, 0.1]


def test_a_broken_scan_is_counted_and_the_others_come(tmp_path):
    for k in range(3):
        write_bin(tmp_path / f"{k}.bin")
    (tmp_path / "1.bin").write_bytes(b"123")
    events: list[Any] = list(open_clouds(tmp_path).events())
    assert [type(event) for event in events] == [RecordedScan, Unusable, RecordedScan]
    assert (events[1].name, events[1].why) == (
        "1.bin",
        "its size is not a multiple of 16 bytes (rows of four float32): truncated",
    )


def test_as_many_poses_as_scans_are_wanted(tmp_path):
    write_bin(tmp_path / "0.bin")
    (tmp_path / "poses.txt").write_text(poses_text([0.0, 1.0]))
    with pytest.raises(DatasetError, match=r"poses\.txt has 2 poses for 1 scans; expected one line per scan"):
        open_clouds(tmp_path)


def test_a_folder_without_scans_is_refused(tmp_path):
    with pytest.raises(DatasetError, match=r"no scans found; give a folder of scans \(\.bin, \.pcd"):
        open_clouds(tmp_path)


@each_format
def test_a_scan_that_vanishes_during_an_import_is_an_error_that_names_it(tmp_path, suffix):
    """Earlier it ended with a traceback. Skipping the scan would lose a part of the map while a disk fails."""
    for number in range(2):
        WRITERS[suffix](tmp_path / f"{number}{suffix}")
    events = open_clouds(tmp_path).events()
    assert isinstance(next(events), RecordedScan)
    (tmp_path / f"1{suffix}").unlink()
    with pytest.raises(DatasetError, match=rf"1\{suffix}: the file is missing, or was removed"):
        next(events)
