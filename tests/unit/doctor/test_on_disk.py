import pytest

from service.doctor import on_disk
from service.maps.reader import MapBundle
from service.maps.writer import write_bundle
from service.scoring.verifier import Verifier


def test_a_valid_bundle_opens_and_its_parts_are_listed(bundle_path):
    told, bundle = on_disk.check_bundle(bundle_path)
    assert told.level == "ok"
    assert told.text.startswith("tiny, version ")
    assert told.text.endswith("12 places")
    assert bundle is not None
    encoder, localizer = on_disk.check_encoder(bundle)
    assert encoder.text == "reads views of 8 x 16 cells and returns descriptors of 16 numbers"
    assert localizer is not None
    assert localizer.bundle is bundle
    assert on_disk.check_streets(bundle).text == "3 streets or sections"
    assert bundle.cloud is not None
    assert on_disk.check_cloud(bundle).text == f"{bundle.manifest.counts.cloud_points} surfels"
    uncalibrated = on_disk.check_calibration(bundle, 0.02)
    assert uncalibrated.level == "warning"
    assert "all of them are LOCALIZED" in uncalibrated.text


def test_a_changed_byte_is_a_problem_with_the_name_of_the_file(bundle_copy):
    file = bundle_copy / "places.npy"
    content = bytearray(file.read_bytes())
    content[-1] ^= 1
    file.write_bytes(bytes(content))
    told, bundle = on_disk.check_bundle(bundle_copy)
    assert bundle is None
    assert (told.level, told.text, told.remedy) == (
        "problem",
        f"{file}: the hash does not match the manifest",
        "copy or build the bundle again",
    )


def test_a_folder_without_a_map_is_a_problem(tmp_path):
    told, bundle = on_disk.check_bundle(tmp_path)
    assert (told.level, bundle) == ("problem", None)
    assert "not a map bundle: manifest.json is missing" in told.text


def test_an_encoder_that_does_not_run_is_a_problem(content_of, tmp_path):
    write_bundle(tmp_path / "own", content_of(encoder=b"no network"))
    told, localizer = on_disk.check_encoder(MapBundle.open(tmp_path / "own"))
    assert (told.level, localizer) == ("problem", None)
    assert told.check == "encoder"
    assert told.text.startswith("ONNX Runtime cannot load the encoder")


def test_a_damaged_verifier_is_a_problem_of_the_installation(bundle_path, tmp_path, monkeypatch):
    damaged = tmp_path / "verifier.onnx"
    damaged.write_bytes(b"no network")
    monkeypatch.setattr(Verifier, "shipped", lambda: Verifier.open(damaged, remedy="install Streetfix again"))
    told, localizer = on_disk.check_encoder(MapBundle.open(bundle_path))
    assert (told.check, told.level, localizer) == ("verifier", "problem", None)
    assert told.text.startswith(f"{damaged}: ONNX Runtime cannot load the verifier")
    assert told.remedy == "install Streetfix again"


@pytest.mark.parametrize(("rate", "level"), [(0.001, "ok"), (0.0005, "problem")])
def test_a_calibration_must_promise_the_rate_of_the_service(content_of, calibration_json, tmp_path, rate, level):
    write_bundle(tmp_path / "own", content_of(calibration=calibration_json()))
    told = on_disk.check_calibration(MapBundle.open(tmp_path / "own"), rate)
    assert told.level == level
    assert told.remedy == ("" if level == "ok" else "set STREETFIX_FALSE_ACCEPT_RATE to 0.001 or more")


def test_the_corrections_for_rigs_are_named(content_of, calibration_json, tmp_path):
    """A map may have one of an earlier release, which is for every rig."""
    numbers = ("frames", "right", "outside", "accepted", "accepted_wrong", "outside_accepted", "offset")
    shares = ("error_before", "error_after", "wrong_share_upper", "outside_share_upper")
    old = {
        "scale": 1,
        "lower_only": True,
        "source": "drive",
        "measured_on": "old",
        **dict.fromkeys((*numbers, *shares), 0),
    }
    camera = {"width": 64, "height": 48, "fx": 32, "fy": 32, "cx": 31.5, "cy": 23.5}
    rigs = [old | {"name": name, "made_for": camera, "measured_on": f"of {name}"} for name in ("mule", "wagon")]
    write_bundle(tmp_path / "own", content_of(calibration=calibration_json(rig=old, rigs=rigs)))
    told = on_disk.check_calibration(MapBundle.open(tmp_path / "own"), 0.01)
    assert told.text == (
        "the map is calibrated, not corrected for this site, and for every rig (old), and for mule (of mule), and for wagon (of wagon)"
    )


def test_a_map_without_cloud_and_streets_gives_warnings(content_of, tmp_path):
    write_bundle(tmp_path / "own", content_of(cloud=None, streets=None, place_street=content_of().place_street * 0 - 1))
    bundle = MapBundle.open(tmp_path / "own")
    assert on_disk.check_cloud(bundle).level == "warning"
    assert on_disk.check_streets(bundle).level == "warning"
