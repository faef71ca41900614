import json
from typing import Any

import cv2
import numpy as np
import pytest

from model_training.importing.recording import RecordedPicture, RecordedScan, Unusable
from model_training.importing.rgbd_folder import open_open3d, open_tum_rgbd
from service.errors import DatasetError
from service.geometry.camera import PinholeCamera

CAMERA = PinholeCamera(8, 6, 8.0, 8.0, 3.5, 2.5)


def write_pair(rgb, depth, steps):
    for path in (rgb, depth):
        path.parent.mkdir(exist_ok=True)
    cv2.imwrite(str(rgb), np.full((6, 8, 3), 51, np.uint8))
    cv2.imwrite(str(depth), np.full((6, 8), steps, np.uint16))


@pytest.fixture
def tum(tmp_path):
    """Write three pairs, a metre apart along the view. The depth of the third is too late."""
    lists = {"rgb.txt": "# colour\n", "depth.txt": "# depth\n", "groundtruth.txt": "# truth\n"}
    for k, late in enumerate((0.0, 0.015, 0.05)):
        write_pair(tmp_path / "rgb" / f"{k}.png", tmp_path / "depth" / f"{k}.png", 10_000)
        lists["rgb.txt"] += f"{k}.0 rgb/{k}.png\n"
        lists["depth.txt"] += f"{k + late} depth/{k}.png\n"
        lists["groundtruth.txt"] += f"{k}.0 0 0 {k} -0.5 0.5 -0.5 0.5\n"
    for name, text in lists.items():
        (tmp_path / name).write_text(text)
    return tmp_path


@pytest.fixture
def open3d(tmp_path):
    for k in range(2):
        write_pair(tmp_path / "color" / f"{k:05d}.jpg", tmp_path / "depth" / f"{k:05d}.png", 2000)
    K = [[8, 0, 3.5], [0, 8, 2.5], [0, 0, 1]]
    told = {"width": 8, "height": 6, "intrinsic_matrix": np.array(K).T.reshape(-1).tolist()}
    (tmp_path / "camera_intrinsic.json").write_text(json.dumps(told))
    frames = [f"{k} {k} {k + 1}\n1 0 0 {k}\n0 1 0 0\n0 0 1 0\n0 0 0 1\n" for k in range(2)]
    (tmp_path / "trajectory.log").write_text("".join(frames))
    return tmp_path


def test_tums_pairs_are_in_time_and_their_depth_in_its_own_steps(tum):
    folder = open_tum_rgbd(tum, CAMERA)
    scans = [e for e in folder.events() if isinstance(e, RecordedScan)]
    pictures = [e for e in folder.events() if isinstance(e, RecordedPicture)]
    assert [p.stamp_s for p in pictures] == [0.0, 1.0]
    assert pictures[0].depth is not None
    np.testing.assert_allclose(pictures[0].depth * pictures[0].depth_scale_m, 2.0)
    x, y, z, grey = scans[0].points.T
    np.testing.assert_allclose(x, 2.0, rtol=1e-6)  # ahead of the camera's body
    np.testing.assert_allclose(grey, 0.2, rtol=1e-6)
    np.testing.assert_allclose(sorted(set(np.round(y, 4))), [-0.125, 0.875], atol=1e-4)
    np.testing.assert_allclose(sorted(set(np.round(z, 4))), [-0.375, 0.625], atol=1e-4)


def test_tums_truth_is_of_the_optical_frame_and_becomes_that_of_the_body(tum):
    trajectory = open_tum_rgbd(tum, CAMERA).trajectory()
    assert trajectory is not None
    T = trajectory.T_map_vehicle
    np.testing.assert_allclose(T[2], [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1]], atol=1e-9)


@pytest.mark.parametrize(
    ("file", "text", "why"),
    [
        ("rgb.txt", None, "rgb.txt is missing"),
        ("depth.txt", "# nothing\n", "depth.txt lists no image; write one line `timestamp file`"),
        ("rgb.txt", "0.0\n", "rgb.txt, line 1: not `timestamp file`: '0.0'; write seconds and a path"),
        ("depth.txt", "99 depth/0.png\n", "no depth image within 0.02 s of any colour image"),
        ("rgb.txt", "0 ../../etc/passwd\n", "the file '../../etc/passwd' is outside the recording; copy it into"),
        ("groundtruth.txt", "0 0 0\n", "groundtruth.txt, line 1"),
    ],
)
def test_missing_entries_of_tum_lists_are_named(tum, file, text, why):
    (tum / file).unlink() if text is None else (tum / file).write_text(text)
    with pytest.raises(DatasetError, match=why):
        open_tum_rgbd(tum, CAMERA)


@pytest.mark.parametrize("layout", ["tum", "open3d"])
def test_the_depth_of_a_stereo_camera_carries_its_baseline(layout, request):
    source, opened = request.getfixturevalue(layout), {"tum": open_tum_rgbd, "open3d": open_open3d}[layout]
    folder = opened(source, CAMERA, 0.05)
    pictures = [event for event in folder.events() if isinstance(event, RecordedPicture)]
    assert [picture.baseline_m for picture in pictures] == [0.05, 0.05]
    assert folder.notes.picture_lines == ()
    (hint,) = opened(source, CAMERA).notes.picture_lines
    assert "give the distance of its cameras with --baseline-m METRES; `evaluate` and" in hint


def test_tums_layout_needs_a_camera_and_does_without_truth(tum):
    (tum / "groundtruth.txt").unlink()
    assert open_tum_rgbd(tum, CAMERA).trajectory() is None
    with pytest.raises(DatasetError, match="give --camera FILE"):
        open_tum_rgbd(tum, None)


def test_open3ds_folder_has_its_own_camera_and_poses(open3d):
    folder = open_open3d(open3d, None)
    assert (folder.camera.fx, folder.camera.cx, folder.camera.cy) == (8.0, 3.5, 2.5)
    events: list[Any] = list(folder.events())
    assert [type(e).__name__ for e in events] == ["RecordedScan", "RecordedPicture"] * 2
    np.testing.assert_allclose(events[1].depth * events[1].depth_scale_m, 2.0)
    trajectory = folder.trajectory()
    assert trajectory is not None
    moved = trajectory.T_map_vehicle
    np.testing.assert_allclose(moved[1, :3, 3] - moved[0, :3, 3], [1, 0, 0])
    np.testing.assert_allclose(moved[0, :3, 0], [0, 0, 1], atol=1e-12)  # ahead is where the optical axis points


@pytest.mark.parametrize("row", ["1 0 0", "nan 0 0 0", "2 0 0 0"])
def test_a_pose_of_open3d_that_is_none_is_named(open3d, row):
    path = open3d / "trajectory.log"
    path.write_text(path.read_text().replace("1 0 0 1", row))
    with pytest.raises(
        DatasetError, match=r"trajectory\.log, line 6: .*; its rotation must be|line 6: .*; write a line of"
    ):
        open_open3d(open3d, None)


def test_open3ds_camera_may_be_given_and_must_be_somewhere(open3d):
    (open3d / "camera_intrinsic.json").write_text("{}")
    with pytest.raises(DatasetError, match=r"camera_intrinsic\.json: not a camera file of Open3D .*give --camera FILE"):
        open_open3d(open3d, None)
    (open3d / "camera_intrinsic.json").unlink()
    with pytest.raises(DatasetError, match="add it, or give --camera FILE"):
        open_open3d(open3d, None)
    assert open_open3d(open3d, CAMERA).camera == CAMERA


def test_as_much_depth_as_colour_is_wanted(open3d):
    (open3d / "depth" / "00001.png").unlink()
    with pytest.raises(DatasetError, match="they have 2 and 1"):
        open_open3d(open3d, None)


def test_damaged_images_and_images_of_another_size_are_counted_together(open3d):
    for k in range(2):
        path = open3d / "depth" / f"{k:05d}.png"
        path.write_bytes(path.read_bytes()[:30])
    bad: list[Any] = list(open_open3d(open3d, None).events())
    assert [type(e) for e in bad] == [Unusable, Unusable]
    assert len({e.why for e in bad}) == 1
    assert bad[0].why.startswith("its depth cannot be read")
    smaller = PinholeCamera(4, 6, 8.0, 8.0, 3.5, 2.5)
    write_pair(open3d / "color" / "00000.jpg", open3d / "depth" / "00000.png", 2000)
    first = next(open_open3d(open3d, smaller).events())
    assert isinstance(first, Unusable)
    assert "sizes differ" in first.why


def test_a_picture_without_any_depth_gives_no_scan(open3d):
    write_pair(open3d / "color" / "00000.jpg", open3d / "depth" / "00000.png", 0)
    first = next(open_open3d(open3d, None).events())
    assert isinstance(first, Unusable)
    assert (first.kind, first.why) == ("scan", "the image has no depth")
