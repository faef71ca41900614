import json

import numpy as np
import pytest

from model_training.importing.extrinsics import Extrinsics, read_camera, read_extrinsics
from model_training.importing.kinds import KINDS, OpenSettings, open_recording
from service.errors import DatasetError
from service.geometry.camera import PinholeCamera


def test_an_unknown_format_is_refused_with_those_there_are(tmp_path):
    with pytest.raises(
        DatasetError, match="'ros3' is not a known format; choose one of: carla, clouds, kitti-360, kitti-odometry"
    ):
        open_recording("ros3", tmp_path, OpenSettings())


@pytest.mark.parametrize("kind", KINDS)
def test_nothing_at_the_name_is_refused(tmp_path, kind):
    with pytest.raises(DatasetError, match="file or folder not found"):
        open_recording(kind, tmp_path / "nowhere", OpenSettings())


@pytest.mark.parametrize(
    ("kind", "settings", "why"),
    [
        ("clouds", OpenSettings(depth="sgbm"), "clouds has no 'sgbm' depth; choose one of: recorded"),
        ("rosbag", OpenSettings(depth="stored"), "rosbag has no 'stored' depth; choose one of: recorded, sgbm, lidar"),
        ("kitti-raw", OpenSettings(topics={"scan": "/x"}), "topic: kitti-raw does not support this option"),
        (
            "carla",
            OpenSettings(camera=PinholeCamera(8, 6, 8.0, 8.0, 3.5, 2.5)),
            "camera: carla does not support this option",
        ),
        ("tum-rgbd", OpenSettings(rectified=False), "rectified: tum-rgbd does not support this option"),
        (
            "clouds",
            OpenSettings(extrinsics=Extrinsics(T_vehicle_lidar=np.eye(4))),
            "extrinsics: clouds does not support this option",
        ),
        ("carla", OpenSettings(baseline_m=0.1), "baseline-m: carla does not support this option"),
        (
            "rosbag",
            OpenSettings(baseline_m=0.1, topics={"right_info": "/r"}),
            "baseline-m 0.1: the topic right_info gives a baseline too; give one of the two",
        ),
        (
            "rosbag",
            OpenSettings(baseline_m=0.1, depth="lidar"),
            "baseline-m 0.1: --depth lidar takes the depth from the scans, so there is no stereo depth; omit one of the two",
        ),
        (
            "rosbag",
            OpenSettings(topics={"right_info": "/r"}, pictures=False),
            "topic right_info: --no-pictures imports no depth, so there is no stereo depth; omit one of the two",
        ),
        (
            "rosbag",
            OpenSettings(topics={"right": "/r"}),
            "topic right: only --depth sgbm matches left and right images; give --depth sgbm too",
        ),
        (
            "rosbag",
            OpenSettings(topics={"depth": "/d"}, depth="sgbm"),
            "topic depth: --depth sgbm computes the depth from left and right images; omit one of the two",
        ),
    ],
)
def test_an_option_that_would_do_nothing_is_refused(tmp_path, kind, settings, why):
    with pytest.raises(DatasetError, match=why):
        open_recording(kind, tmp_path, settings)


def test_mountings_are_read(tmp_path):
    T = [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
    (tmp_path / "rig.json").write_text(json.dumps({"T_vehicle_lidar": T}))
    found = read_extrinsics(tmp_path / "rig.json")
    np.testing.assert_array_equal(found.T_vehicle_lidar, T)
    assert found.T_vehicle_camera is None


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("{", "cannot be read as JSON"),
        ("[]", "found list; write an object with T_vehicle_lidar or T_vehicle_camera"),
        ('{"T_lidar": 1}', "found T_lidar; write an object with"),
        ('{"T_vehicle_lidar": "here"}', "T_vehicle_lidar is not a matrix of numbers; write 4 rows"),
        (
            '{"T_vehicle_lidar": [[1, 0], [0, 1]]}',
            "has shape .2, 2. or a wrong last row; write 4 rows of 4 finite numbers",
        ),
        ('{"T_vehicle_lidar": [[2,0,0,0],[0,2,0,0],[0,0,2,0],[0,0,0,1]]}', "has no valid rotation"),
        ('{"T_vehicle_lidar": [[1,0,0,0],[0,1,0,0],[0,0,-1,0],[0,0,0,1]]}', "has no valid rotation"),
    ],
)
def test_mountings_that_are_none_are_refused_with_the_file(tmp_path, text, why):
    (tmp_path / "rig.json").write_text(text)
    with pytest.raises(DatasetError, match=f"rig.json: .*{why}"):
        read_extrinsics(tmp_path / "rig.json")


def test_a_camera_is_read_alone_or_out_of_a_request(tmp_path):
    told = {"width": 8, "height": 6, "fx": 9, "fy": 10, "cx": 3.5, "cy": 2.5, "distortion": [0.1, 0, 0, 0]}
    for document in (told, {"map": "x", "camera": told}):
        (tmp_path / "camera.json").write_text(json.dumps(document))
        assert read_camera(tmp_path / "camera.json") == PinholeCamera(8, 6, 9.0, 10.0, 3.5, 2.5, (0.1, 0.0, 0.0, 0.0))


def test_a_fisheye_camera_is_read(tmp_path):
    told = {"width": 8, "height": 6, "fx": 9, "fy": 10, "cx": 3.5, "cy": 2.5, "distortion": [0, 0, 0, 0]}
    (tmp_path / "camera.json").write_text(json.dumps(told | {"distortion_model": "kannala_brandt"}))
    assert read_camera(tmp_path / "camera.json").is_distorted


@pytest.mark.parametrize(
    ("lens", "why"),
    [
        (
            {"distortion": [0.1]},
            "distortion: the model brown_conrady does not have 1 coefficients; send 4, 5, 8, 12 or 14",
        ),
        (
            {"distortion_model": "omni"},
            "distortion_model: 'omni' is not valid; choose one of: brown_conrady, kannala_brandt",
        ),
        ({"distortion_model": "kannala_brandt"}, "does not have 0 coefficients; send 4 of k1"),
    ],
)
def test_a_lens_that_is_none_is_refused_with_the_file(tmp_path, lens, why):
    told = {"width": 8, "height": 6, "fx": 9, "fy": 10, "cx": 3.5, "cy": 2.5}
    (tmp_path / "camera.json").write_text(json.dumps(told | lens))
    with pytest.raises(DatasetError, match=rf"camera\.json: .*{why}"):
        read_camera(tmp_path / "camera.json")


@pytest.mark.parametrize(
    "text", ["{", "[]", "{}", '{"width": 8, "height": 6, "fx": 0, "fy": 1, "cx": 0, "cy": 0}', '{"width": "wide"}']
)
def test_a_camera_that_is_none_is_refused_with_the_file(tmp_path, text):
    (tmp_path / "camera.json").write_text(text)
    with pytest.raises(DatasetError, match=r"camera\.json.*(write JSON with width|Give the values)"):
        read_camera(tmp_path / "camera.json")
