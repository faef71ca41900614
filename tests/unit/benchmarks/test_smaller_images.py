"""A KITTI drive with smaller images."""

import cv2
import numpy as np
import pytest

from benchmarks.real.smaller_images import scaled, write_smaller_images

PROJECTION = [700.0, 0.0, 599.5, -380.0, 0.0, 700.0, 179.5, 4.0, 0.0, 0.0, 1.0, 0.0027]


def shape_of(file):
    image = cv2.imread(str(file))
    assert image is not None
    return image.shape


def values(line):
    return [float(each) for each in line.partition(":")[2].split()]


def test_a_projection_keeps_its_rays_and_its_baseline():
    line = scaled("P_rect_03: " + " ".join(map(str, PROJECTION)), 4)
    found = values(line)
    assert line.startswith("P_rect_03: ")
    assert found == pytest.approx([175.0, 0, 149.5, -95.0, 0, 175.0, 44.5, 1.0, 0, 0, 1, 0.0027])
    assert found[3] / found[0] == pytest.approx(PROJECTION[3] / PROJECTION[0])
    # The right edge of 1,200 columns is the right edge of 300 columns.
    assert pytest.approx((299.5 - found[2]) / found[0]) == (1199.5 - 599.5) / 700


def test_the_size_is_divided_and_other_lines_stay():
    assert values(scaled("S_rect_02: 1.242000e+03 3.750000e+02", 3)) == [414, 125]
    assert scaled("R_rect_02: 1 0 0", 3) == "R_rect_02: 1 0 0"
    assert scaled("K_02: 9 0 6", 3) == "K_02: 9 0 6"


def test_a_copy_has_small_images_and_all_other_files(tmp_path):
    drive = tmp_path / "raw" / "2011_09_26" / "2011_09_26_drive_0005_sync"
    (drive / "image_02" / "data").mkdir(parents=True)
    (drive / "oxts").mkdir()
    (drive / "oxts" / "dataformat.txt").write_text("lat\n")
    cv2.imwrite(str(drive / "image_02" / "data" / "0.png"), np.full((30, 60, 3), 90, np.uint8))
    (drive.parent / "calib_cam_to_cam.txt").write_text("S_rect_02: 60 30\n")
    (drive.parent / "calib_velo_to_cam.txt").write_text("R: 1\n")
    copy = write_smaller_images(drive, tmp_path / "small", 3)
    assert copy == tmp_path / "small" / drive.name
    assert shape_of(copy / "image_02" / "data" / "0.png") == (10, 20, 3)
    assert values((copy.parent / "calib_cam_to_cam.txt").read_text()) == [20, 10]
    assert (copy.parent / "calib_velo_to_cam.txt").read_text() == "R: 1\n"
    assert (copy / "oxts" / "dataformat.txt").read_text() == "lat\n"
    assert shape_of(drive / "image_02" / "data" / "0.png") == (30, 60, 3)
