"""``streetfix calibrate`` as a person calls it: wrong use. ``tests/unit/calibration/test_own_drive.py`` has right use."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from service.cli.main import main
from service.maps.writer import replace_calibration


def run(*arguments: str | Path) -> int:
    with pytest.raises(SystemExit) as end:
        main([str(argument) for argument in arguments])
    return int(end.value.code or 0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--drive", "x"), "--drive corrects the confidence of a map; give the map with --map"),
        (("--rig", "x"), "--rig corrects the confidence of a map; give the map with --map"),
        (("--queries", "x"), "--queries corrects the confidence of a map; give the map with --map"),
        (("--odometry-noise", "0.1"), "--odometry-noise corrects the confidence of a map"),
        (("--workers", "1"), "--workers corrects the confidence of a map"),
        (("--map", "m", "--drive", "x", "--encoder", "e"), "leave out --encoder"),
        (("--map", "m", "--drive", "x", "--anew"), "leave out --anew"),
        (("--map", "m", "--rig", "x", "--work", "w"), "leave out --work"),
        (("--map", "m"), "--map needs either --drive or --rig"),
        (("--map", "m", "--rig", "x", "--queries", "q"), "--queries belongs to --drive"),
        (("--map", "m", "--rig", "x", "--odometry-noise", "0.1"), "--odometry-noise belongs to --drive"),
    ],
)
def test_options_that_do_not_go_together_are_refused(
    arguments: tuple[str, ...], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("calibrate", *arguments) == 2
    assert message in " ".join(capsys.readouterr().err.split())


def test_both_sources_at_once_are_refused(small_dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = ("--drive", small_dataset.folder, "--rig", tmp_path / "rig.json")
    assert run("calibrate", "--map", tmp_path, *given) == 2
    assert "--map needs either --drive or --rig" in " ".join(capsys.readouterr().err.split())


def test_a_folder_that_is_no_map_is_named(small_dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("calibrate", "--map", tmp_path / "none", "--drive", small_dataset.folder) == 1
    assert "none: not a map bundle: manifest.json is missing" in capsys.readouterr().err


def test_a_map_and_a_dataset_in_the_wrong_order_are_named(
    small_dataset, small_map: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("calibrate", "--map", small_dataset.folder, "--drive", small_map) == 1
    assert "is a dataset and" in capsys.readouterr().err


def test_a_map_without_calibration_is_refused(
    small_dataset, small_map: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("calibrate", "--map", small_map, "--drive", small_dataset.folder) == 1
    assert "the map is not calibrated, so there is no confidence to correct" in capsys.readouterr().err


def test_a_rig_file_that_is_wrong_is_named_by_field(
    small_map: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "rig.json"
    path.write_text(json.dumps({"camera": {"width": 640}}))
    assert run("calibrate", "--map", small_map, "--rig", path) == 1
    assert f"{path}: camera.height: Field required" in capsys.readouterr().err


@pytest.mark.parametrize("inside", [True, False])
def test_a_file_that_cannot_be_written_is_refused_before_the_work(
    small_map: Path, small_dataset, tmp_path: Path, inside: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    out = small_map / "calibration.json" if inside else tmp_path / "no" / "calibration.json"
    assert run("calibrate", "--map", small_map, "--drive", small_dataset.folder, "--out", out) == 1
    assert ("lies in the map bundle" if inside else "not found; create it first") in capsys.readouterr().err


def test_an_interrupt_leaves_the_map_as_it_was(
    small_map: Path,
    small_dataset,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    calibration_json: Callable[..., object],
) -> None:
    from model_training.cli import calibrate

    shutil.copytree(small_map, tmp_path / "town")
    replace_calibration(tmp_path / "town", calibration_json())  # type: ignore[arg-type]
    manifest = (tmp_path / "town" / "manifest.json").read_bytes()

    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(calibrate, "learn_correction", interrupted)
    assert run("calibrate", "--map", tmp_path / "town", "--drive", small_dataset.folder) != 0
    assert (tmp_path / "town" / "manifest.json").read_bytes() == manifest
    assert [path.name for path in tmp_path.iterdir()] == ["town"]
