"""Place recognition by hand, and which drives lie below a folder."""

import numpy as np
import pytest

from benchmarks.kitti.protocol import found_within
from benchmarks.kitti.sources import PUBLISHED, drives_below, missing

PLACES_XY = np.array([[0.0, 0.0], [20.0, 0.0], [40.0, 0.0]])
PLACES_S = np.array([0.0, 2.0, 100.0])


def found(similarity, query_xy, query_s, left_out_s):
    right, asked = found_within(
        np.array([similarity], np.float32), np.array([query_xy]), PLACES_XY, query_s=np.array([query_s]), place_s=PLACES_S,
        left_out_s=left_out_s,
    )  # fmt: skip
    return bool(right[0]), bool(asked[0])


@pytest.mark.parametrize(
    ("similarity", "left_out_s", "expected"),
    [
        ([0.9, 0.5, 0.1], 0.05, (True, True)),
        ([0.5, 0.9, 0.1], 0.05, (False, True)),  # 17 m away
        ([0.9, 0.5, 0.1], 5.0, (False, False)),  # its own place was scanned just now, and no other is near
    ],
)
def test_the_most_similar_place_that_counts_must_be_near(similarity, left_out_s, expected):
    assert found(similarity, [3.0, 0.0], 1.0, left_out_s) == expected


def test_a_place_of_the_same_moment_does_not_count_but_one_of_another_time_does():
    """The query came back after 100 s to where it was at 0 s."""
    assert found([0.9, 0.2, 0.95], [1.0, 0.0], 100.0, 60.0) == (True, True)


def drive(root, *parts):
    for part in parts:
        (root / part).mkdir(parents=True)


def test_drives_are_found_wherever_they_lie(tmp_path):
    drive(tmp_path, "odometry/dataset/sequences/05/velodyne", "odometry/dataset/sequences/05/image_3")
    drive(tmp_path, "odometry/dataset/sequences/06/velodyne")  # no right pictures: no stereo depth
    raw = "raw/2011_09_30/2011_09_30_drive_0027_sync"
    drive(tmp_path, f"{raw}/velodyne_points/data", f"{raw}/image_03", f"{raw}/oxts")
    found = drives_below(tmp_path)
    assert [(each.name, each.kind, each.packed) for each in found] == [
        ("05", "kitti-odometry", False), ("2011_09_30_drive_0027", "kitti-raw", False),
    ]  # fmt: skip
    drive(tmp_path, "360/data_3d_raw/2013_05_28_drive_0000_sync/velodyne_points/data")
    drive(tmp_path, "360/data_2d_raw/2013_05_28_drive_0000_sync/image_01/data_rect")
    assert drives_below(tmp_path) == found  # no poses, nothing to measure
    drive(tmp_path, "360/data_poses/2013_05_28_drive_0000_sync")
    (tmp_path / "360/data_poses/2013_05_28_drive_0000_sync/poses.txt").touch()
    assert [each.name for each in drives_below(tmp_path) if each.kind == "kitti-360"] == ["2013_05_28_drive_0000"]
    assert not any("KITTI-360" in line for line in missing(drives_below(tmp_path)))
    assert any("KITTI-360" in line for line in missing(found))
    words = missing(found)
    assert [name for name in PUBLISHED if any(f"sequence {name} " in line for line in words)] == [
        name for name in PUBLISHED if name != "05"
    ]
    assert not any("2011_09_30_drive_0027" in line for line in words)


def test_a_packed_drive_is_told_apart(tmp_path):
    raw = tmp_path / "kitti_0005/2011_09_26/2011_09_26_drive_0005_sync"
    drive(raw, "velodyne_points/data", "image_03", "oxts")
    (raw / "velodyne_points/data/0000000000.xz").touch()
    (found,) = drives_below(tmp_path)
    assert (found.packed, found.folder) == (True, tmp_path / "kitti_0005")
