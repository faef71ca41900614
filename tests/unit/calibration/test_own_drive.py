"""The small map by the stock encoder, asked its five image pairs, with ground truth and with odometry."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from model_training.calibration import elsewhere, rendered_rig
from model_training.calibration.odometry_labels import LABEL_NOISE
from model_training.calibration.own_drive import frames_of_drive, images_of_drive
from model_training.calibration.own_rig import learn_correction
from model_training.cli import calibrate
from model_training.datasets.dataset import Dataset, query_folder, read_tum, write_tum
from service.cli.main import main
from service.confidence.features import FEATURES
from service.errors import DatasetError, RequestError
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import inverse
from service.localization.localizer import Localizer
from service.maps.calibration import read_calibration
from service.maps.reader import MapBundle
from service.maps.rig_key import RigKey

KEY = ("width", "height", "fx", "fy", "cx", "cy")


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
    (rig,) = after.calibration.rigs
    assert after.calibration.rig is None
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
    again = learn_correction(
        before.calibration,
        found.frames,
        source="drive",
        measured_on=found.described,
        name="small",
        made_for=found.rig,
    )
    assert again == rig
    assert run("map", "info", town) == 0
    assert f"corrected for small by {rig.frames} frames" in capsys.readouterr().out


def test_a_rig_is_added_to_that_of_a_recording_and_the_answers_of_each_state_their_correction(
    town, small_dataset, few_places, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr(rendered_rig, "IMAGES", 4)
    depth = {"noise_share": 0.01, "min_range_m": 0.4, "max_range_m": 30}
    wide = {"width": 96, "height": 72, "fx": 40, "fy": 40, "cx": 47.5, "cy": 35.5, "height_m": 1.5}
    (tmp_path / "rig.json").write_text(json.dumps({"name": "wide", "camera": wide, "depth": depth}))
    given = ("calibrate", "--map", town, "--workers", "1")
    assert run(*given, "--drive", small_dataset.folder) == 0
    assert run(*given, "--rig", tmp_path / "rig.json") == 0
    assert "kept: the corrections of other rigs (small)" in capsys.readouterr().out
    assert run(*given, "--drive", small_dataset.folder) == 0
    out = capsys.readouterr().out
    assert "replaced: the correction small of the same rig" in out
    assert "kept: the corrections of other rigs (wide)" in out
    bundle = MapBundle.open(town)
    assert bundle.calibration is not None
    assert [each.name for each in bundle.calibration.rigs] == ["wide", "small"]
    localizer = Localizer.open(bundle)
    query = next(iter(small_dataset.queries(*small_dataset.query_sets()))).query(bundle.grid)
    wider, other = (PinholeCamera(96, 72, focal, focal, 47.5, 35.5) for focal in (40.0, 60.0))
    for name, camera in (("small", query.camera), ("wide", wider), (None, other)):
        assert localizer.localize(replace(query, camera=camera)).rig_correction == name


def test_a_correction_of_the_same_camera_with_another_baseline_gives_a_warning(town, drive, few_places, capsys):
    given = ("calibrate", "--map", town, "--drive", drive, "--workers", "1")
    assert run(*given) == 0
    assert run(*given) == 0
    assert "warning" not in capsys.readouterr().out  # the same rig: replaced
    file = drive / "dataset.json"
    told = json.loads(file.read_text())
    told["sensors"]["cameras"][0]["depth"]["baseline_m"] = 0.12
    file.write_text(json.dumps(told))
    assert run(*given) == 0
    (line,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("warning: ")]
    assert line.startswith("warning: the kept correction small is for the same camera with no baseline and")
    assert "this one is for baseline 0.12 m and" in line
    assert "with its baseline (--baseline-m), and calibrate again" in line


def test_a_rate_that_the_images_cannot_support_is_refused_before_the_work(town, small_dataset, capsys, monkeypatch):
    def nothing_is_asked(*_, **__):
        raise AssertionError("the work began")

    monkeypatch.setattr(calibrate, "frames_of_drive", nothing_is_asked)
    version = MapBundle.open(town).manifest.version
    given = ("--drive", small_dataset.folder, "--false-accept-rate", "0.01")
    assert run("calibrate", "--map", town, *given) == 1
    said = " ".join(capsys.readouterr().err.split())
    assert "--false-accept-rate 0.01: it needs 299 images, and the recording has 5; record more images" in said
    assert "(a rate of 0.46 or more)" in said  # 1 - 0.05 ** (1 / 5) = 0.451
    assert MapBundle.open(town).manifest.version == version


def test_a_rate_that_the_images_support_sets_the_thresholds_of_this_rig(town, drive, few_places, capsys):
    """Ten images give six out-of-map frames at least, and five support 0.46. The answers of this rig then have this rate."""
    (name,) = Dataset(drive).query_sets()
    shutil.copytree(query_folder(drive, name), query_folder(drive, "again"))
    given = ("calibrate", "--map", town, "--drive", drive, "--workers", "1", "--false-accept-rate", "0.46")
    assert run(*given) == 0
    assert "threshold for a false-accept rate of 0.46: confidence" in capsys.readouterr().out
    bundle = MapBundle.open(town)
    assert bundle.calibration is not None
    (rig,) = bundle.calibration.rigs
    assert rig.outside >= 6
    assert rig.thresholds[-1].false_accept_rate == 0.46
    localizer = Localizer.open(bundle)
    query = replace(next(iter(Dataset(drive).queries(name))).query(bundle.grid), rate_is_named=True)
    answer = localizer.localize(replace(query, false_accept_rate=0.46))
    assert answer.threshold == rig.thresholds[-1]
    with pytest.raises(
        RequestError, match=r"0\.01 is below what the recording of this rig supports \(small, \d+ out-of-map frames"
    ):
        localizer.localize(replace(query, false_accept_rate=0.01))
    # The default of the service is for all rigs. It is answered, by the stricter threshold.
    unnamed = localizer.localize(replace(query, false_accept_rate=0.01, rate_is_named=False))
    assert unnamed.threshold is not None
    assert unnamed.threshold.confidence == max(rig.thresholds[0].confidence, bundle.calibration.threshold(0.01))
    # Another rig has the thresholds of the map.
    other = replace(query, camera=PinholeCamera(96, 72, 60.0, 60.0, 47.5, 35.5), false_accept_rate=0.01)
    assert localizer.localize(other).threshold == bundle.calibration.threshold_at(0.01)


def test_images_of_several_rigs_need_a_camera(localizer, drive):
    """The second camera has half the focal length. Its images are 0, 2 and 4."""
    path = drive / "dataset.json"
    description = json.loads(path.read_text())
    (first,) = description["sensors"]["cameras"]
    other = first | {"name": "rear", "fx": first["fx"] / 2, "fy": first["fy"] / 2}
    path.write_text(json.dumps(description | {"sensors": description["sensors"] | {"cameras": [first, other]}}))
    poses_of(drive).with_name("cameras.txt").write_text("\n".join(["rear", first["name"]] * 2 + ["rear"]))
    with pytest.raises(DatasetError, match=r"come from several rigs \(rear: 96 x 72 pixels.*choose one with --camera"):
        images_of_drive(Dataset(drive), [])
    with pytest.raises(DatasetError, match=r"--camera: no image of .* is of the camera 'side'; choose one of rear, "):
        images_of_drive(Dataset(drive), [], "side")
    assert [frame.number for frame in images_of_drive(Dataset(drive), [], "rear")] == [0, 2, 4]
    found = frames_of_drive(localizer, Dataset(drive), [], odometry_noise=0.02, camera=first["name"], workers=1)
    assert (found.name, found.rig.fx) == (f"small {first['name']}", first["fx"])
    assert (~found.frames.outside).sum() == 2


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
    (rig,) = calibration.rigs
    assert (rig.source, rig.name) == ("rendered", "rig")
    assert rig.made_for == RigKey(**{name: camera[name] for name in KEY}, max_range_m=30.0)
    assert rig.scale <= 1 + 1e-6  # the optimiser's tolerance
    assert sorted(path.name for path in tmp_path.iterdir()) == ["calibration.json", "rig.json", "town"]
    given = ("--calibration", out, "--headings", "2", "--spacing", "20", "--no-align-survey")
    assert run("build-map", small_dataset.folder, "--out", tmp_path / "again", *given) == 0
    built = MapBundle.open(tmp_path / "again")
    assert built.calibration is not None
    assert built.calibration.rigs == calibration.rigs
