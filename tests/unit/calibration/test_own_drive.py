"""The small map by the stock encoder, asked its five image pairs, with ground truth and with odometry."""

import json
import shutil

import numpy as np
import pytest

from model_training.calibration import elsewhere
from model_training.calibration.odometry_labels import LABEL_NOISE
from model_training.calibration.own_drive import frames_of_drive
from model_training.calibration.own_rig import learn_correction
from model_training.datasets.dataset import Dataset, query_folder, read_tum, write_tum
from service.cli.main import main
from service.confidence.features import FEATURES
from service.errors import DatasetError
from service.geometry.rigid import inverse
from service.localization.localizer import Localizer
from service.maps.calibration import read_calibration
from service.maps.reader import MapBundle


def run(*arguments):
    with pytest.raises(SystemExit) as end:
        main([str(argument) for argument in arguments])
    return int(end.value.code or 0)


@pytest.fixture(scope="module")
def localizer(stock_map):
    return Localizer.open(MapBundle.open(stock_map))


@pytest.fixture
def drive(small_dataset, tmp_path):
    """A copy, to change its poses."""
    shutil.copytree(small_dataset.folder, tmp_path / "drive")
    return tmp_path / "drive"


@pytest.fixture
def few_places(monkeypatch):
    """The small map has twelve places within 60 m."""
    monkeypatch.setattr(elsewhere, "FEWEST_LEFT", 2)


def poses_of(folder):
    (name,) = Dataset(folder).query_sets()
    return query_folder(folder, name) / "poses.txt"


def test_ground_truth_labels_all_images_and_each_is_asked_again_elsewhere(localizer, small_dataset, few_places):
    told = []
    found = frames_of_drive(
        localizer, small_dataset, [], odometry_noise=0.02, workers=1, report=lambda *event: told.append(event)
    )
    (name,) = small_dataset.query_sets()
    assert {event[0] for event in told} == {f"queries {name}", f"out-of-map {name}"}
    frames = found.frames
    assert (found.unlabelled, found.unregistered, found.label_noise) == (0, 0, 0.0)
    assert found.described == f"small, {name}, labelled by ground truth, 0 images from outside the map"
    assert (~frames.outside).sum() == 5
    assert frames.right.sum() >= 4
    assert 3 <= frames.outside.sum() <= 5
    assert frames.block[~frames.outside].tolist() == [0, 1, 2, 3, 4]
    assert frames.evidence.shape[1] == len(FEATURES)


def test_an_image_from_beyond_the_map_is_an_out_of_map_frame(localizer, drive, few_places):
    path = poses_of(drive)
    stamps, poses = read_tum(path)
    poses[4, :2, 3] += 500.0
    write_tum(path, stamps, poses)
    found = frames_of_drive(localizer, Dataset(drive), [], odometry_noise=0.02, workers=1)
    assert (~found.frames.outside).sum() == 4
    assert found.described.endswith("1 images from outside the map")
    assert not found.frames.right[found.frames.outside].any()


def test_odometry_labels_images_without_ground_truth(localizer, drive, few_places):
    path = poses_of(drive)
    stamps, poses = read_tum(path)
    truth = frames_of_drive(localizer, Dataset(drive), [], odometry_noise=0.001, workers=1).frames
    path.unlink()
    write_tum(path.with_name("odometry.txt"), stamps, np.stack([inverse(poses[0]) @ T for T in poses]))
    found = frames_of_drive(localizer, Dataset(drive), [], odometry_noise=0.001, workers=1)
    assert found.label_noise == LABEL_NOISE
    assert "labelled by odometry" in found.described
    labelled, inside = ~found.frames.outside, ~truth.outside
    assert labelled.sum() + found.unlabelled == inside.sum() == 5
    assert found.frames.right.sum() >= 3
    right = dict(zip(truth.block[inside], truth.right[inside], strict=True))
    np.testing.assert_array_equal(found.frames.right[labelled], [right[k] for k in found.frames.block[labelled]])


def test_a_set_that_nothing_labels_is_refused_with_what_is_needed(localizer, drive):
    path = poses_of(drive)
    path.unlink()
    with pytest.raises(
        DatasetError, match=r"neither poses\.txt nor odometry\.txt.*add one of them: poses\.txt with T_map_camera"
    ):
        frames_of_drive(localizer, Dataset(drive), [], odometry_noise=0.02)
    write_tum(path.with_name("odometry.txt"), np.arange(2.0), np.tile(np.eye(4), (2, 1, 1)))
    with pytest.raises(DatasetError, match=r"odometry\.txt has 2 lines, none for 000004"):
        frames_of_drive(localizer, Dataset(drive), [], odometry_noise=0.02)


def test_a_dataset_without_images_is_refused(localizer, drive):
    shutil.rmtree(drive / "queries")
    with pytest.raises(DatasetError, match="has no query sets"):
        frames_of_drive(localizer, Dataset(drive), [], odometry_noise=0.02)


@pytest.fixture
def town(stock_map, tmp_path, calibration_json):
    """A copy of the map, with a calibration for its encoder."""
    from service.maps.writer import replace_calibration

    shutil.copytree(stock_map, tmp_path / "town")
    sha256 = MapBundle.open(stock_map).manifest.encoder_sha256
    replace_calibration(tmp_path / "town", calibration_json(measured_on={"encoder_sha256": sha256}))
    return tmp_path / "town"


def test_a_recording_corrects_the_map(town, small_dataset, few_places, capsys):
    before = MapBundle.open(town)
    assert run("calibrate", "--map", town, "--drive", small_dataset.folder, "--workers", "1") == 0
    out = capsys.readouterr().out
    after = MapBundle.open(town)
    assert after.calibration is not None
    rig = after.calibration.rig
    assert rig is not None
    assert (rig.source, rig.frames - rig.outside) == ("drive", 5)
    assert after.manifest.version != before.manifest.version
    for line in (
        f"frames: {rig.frames} labelled",
        "calibration error: ",
        "took_s: ",
        f"version {after.manifest.version}",
    ):
        assert line in out
    assert f"{rig.outside} out-of-map frames cannot support a rate of" in out
    # What is stored is what the frames give.
    found = frames_of_drive(Localizer.open(before), small_dataset, [], odometry_noise=0.02, workers=1)
    assert before.calibration is not None
    assert learn_correction(before.calibration, found.frames, source="drive", measured_on=found.described) == rig
    assert run("map", "info", town) == 0
    assert f"corrected for a rig by {rig.frames} frames" in capsys.readouterr().out


def test_a_rig_file_makes_a_calibration_that_build_map_takes(town, small_dataset, few_places, tmp_path, capsys):
    camera = {"width": 96, "height": 72, "fx": 48, "fy": 48, "cx": 47.5, "cy": 35.5, "height_m": 1.5}
    rig_json, out = tmp_path / "rig.json", tmp_path / "calibration.json"
    rig_json.write_text(
        json.dumps({"camera": camera, "depth": {"noise_share": 0.01, "min_range_m": 0.4, "max_range_m": 30}})
    )
    version = MapBundle.open(town).manifest.version
    assert run("calibrate", "--map", town, "--rig", rig_json, "--out", out) == 0
    assert f"written: {out}" in capsys.readouterr().out
    assert MapBundle.open(town).manifest.version == version, "--out leaves the map as it is"
    calibration = read_calibration(out.read_bytes(), path=str(out))
    assert calibration is not None
    assert calibration.rig is not None
    assert calibration.rig.source == "rendered"
    assert calibration.rig.scale <= 1 + 1e-6  # the optimiser's tolerance
    assert sorted(path.name for path in tmp_path.iterdir()) == ["calibration.json", "rig.json", "town"]
    given = ("--calibration", out, "--headings", "2", "--spacing", "20", "--no-align-survey")
    assert run("build-map", small_dataset.folder, "--out", tmp_path / "again", *given) == 0
    built = MapBundle.open(tmp_path / "again")
    assert built.calibration is not None
    assert built.calibration.rig == calibration.rig
