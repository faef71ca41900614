"""``streetfix calibrate`` as a person calls it: wrong use, and renewal. ``tests/unit/calibration/test_own_drive.py`` has corrections."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from service.cli.main import main
from service.errors import BundleError
from service.localization.localizer import Localizer
from service.maps.calibration import Site
from service.maps.manifest import read_manifest
from service.maps.reader import MapBundle
from service.maps.writer import replace_calibration

SITE = {"offset": -1.0, "queries": 200, "right": 150, "expected_calibration_error": 0.02}


def run(*arguments: str | Path) -> int:
    with pytest.raises(SystemExit) as end:
        main([str(argument) for argument in arguments])
    return int(end.value.code or 0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--drive", "x"), "--drive changes the confidence of a map; give the map with --map"),
        (("--rig", "x"), "--rig changes the confidence of a map; give the map with --map"),
        (("--queries", "x"), "--queries changes the confidence of a map; give the map with --map"),
        (("--odometry-noise", "0.1"), "--odometry-noise changes the confidence of a map"),
        (("--workers", "1"), "--workers changes the confidence of a map"),
        (("--map", "m", "--drive", "x", "--encoder", "e"), "leave out --encoder"),
        (("--map", "m", "--drive", "x", "--anew"), "leave out --anew"),
        (("--map", "m", "--rig", "x", "--work", "w"), "leave out --work"),
        (("--map", "m"), "--map needs either --drive, --rig or --calibration"),
        (("--calibration", "c"), "--calibration changes the confidence of a map; give the map with --map"),
        (("--map", "m", "--calibration", "c", "--rig", "x"), "leave out --rig"),
        (("--map", "m", "--calibration", "c", "--out", "o"), "leave out --out"),
        (("--map", "m", "--rig", "x", "--queries", "q"), "--queries belongs to --drive"),
        (("--map", "m", "--rig", "x", "--odometry-noise", "0.1"), "--odometry-noise belongs to --drive"),
        (("--map", "m", "--rig", "x", "--camera", "c"), "--camera belongs to --drive"),
        (("--map", "m", "--rig", "x", "--false-accept-rate", "0.1"), "--false-accept-rate belongs to --drive"),
        (("--false-accept-rate", "0.1"), "--false-accept-rate changes the confidence of a map"),
        (("--map", "m", "--drive", "x", "--false-accept-rate", "0.6"), "should be less than or equal to 0.5"),
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
    assert "--map needs either --drive, --rig or --calibration" in " ".join(capsys.readouterr().err.split())


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


@pytest.fixture(params=[("rig", {"offset": -0.3}), ("rigs", [{"name": "mule"}])], ids=["one", "several"])
def corrections(request: pytest.FixtureRequest) -> tuple[str, object]:
    """Return the field of an earlier release with a correction for a rig, and that of this release."""
    return request.param


@pytest.fixture
def town(
    small_map: Path,
    tmp_path: Path,
    calibration_json: Callable[..., dict[str, Any]],
    corrections: tuple[str, object],
) -> Path:
    """Return a map whose calibration has other features than this release computes, a site check and corrections for rigs."""
    shutil.copytree(small_map, tmp_path / "town")
    old = calibration_json(site=SITE) | {
        "features": [{"name": "of_old", "mean": 0.0, "std": 1.0}],
        corrections[0]: corrections[1],
    }
    replace_calibration(tmp_path / "town", old)
    return tmp_path / "town"


def test_a_calibration_of_an_earlier_release_is_renewed_and_the_site_check_stays(
    town: Path, tmp_path: Path, calibration_json: Callable[..., dict[str, Any]], capsys: pytest.CaptureFixture[str]
) -> None:
    before = read_manifest(town)
    with pytest.raises(
        BundleError, match="renew the calibration with `streetfix calibrate --map MAP --calibration stock`"
    ):
        Localizer.open(MapBundle.open(town))
    file = tmp_path / "new.json"
    file.write_text(json.dumps(calibration_json(measured_on={"encoder_sha256": before.encoder_sha256})))
    assert run("calibrate", "--map", town, "--calibration", file) == 0
    said = capsys.readouterr().out
    assert "removed: the corrections for rigs" in said
    assert str(town) in said
    bundle = MapBundle.open(town)
    Localizer.open(bundle)
    assert bundle.manifest.version != before.version
    assert bundle.calibration is not None
    assert (bundle.calibration.site, bundle.calibration.rig, bundle.calibration.rigs) == (
        Site.model_validate(SITE),
        None,
        (),
    )


def test_the_calibration_of_another_encoder_is_refused_and_the_map_stays(
    town: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    manifest = (town / "manifest.json").read_bytes()
    assert run("calibrate", "--map", town, "--calibration", "stock") == 1
    assert "is not the calibration of the encoder of this map" in capsys.readouterr().err
    assert (town / "manifest.json").read_bytes() == manifest


@pytest.mark.parametrize("damage", [b"{", b"[]", b'{"site": 3}', b'{"site": {"offset": 1}}'])
def test_a_site_check_that_cannot_be_read_is_refused(
    town: Path,
    tmp_path: Path,
    damage: bytes,
    calibration_json: Callable[..., dict[str, Any]],
    capsys: pytest.CaptureFixture[str],
) -> None:
    file = tmp_path / "new.json"
    file.write_text(json.dumps(calibration_json(measured_on={"encoder_sha256": read_manifest(town).encoder_sha256})))
    (town / "calibration.json").write_bytes(damage)
    assert run("calibrate", "--map", town, "--calibration", file) == 1
    assert "calibration.json: its site check cannot be read; build the map again" in capsys.readouterr().err


def test_a_calibration_file_that_does_not_exist_is_named(town: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("calibrate", "--map", town, "--calibration", "none.json") == 1
    assert "none.json cannot be read" in capsys.readouterr().err
