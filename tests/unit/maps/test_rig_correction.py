"""The correction of the confidence for a rig, and how it gets into a bundle."""

import errno
import json
import os
import subprocess
import sys
import textwrap

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from service.confidence.decision import decide
from service.confidence.features import FEATURES
from service.errors import BundleError
from service.maps import writer
from service.maps.calibration import RigCorrection, probability, read_calibration
from service.maps.reader import MapBundle
from service.maps.rig_key import RigKey
from service.maps.writer import replace_calibration, write_bundle

RIG = {
    "scale": 0.5,
    "offset": -1.0,
    "lower_only": False,
    "source": "drive",
    "measured_on": "a drive",
    "frames": 40,
    "right": 20,
    "outside": 15,
    "error_before": 0.2,
    "error_after": 0.05,
    "accepted": 18,
    "accepted_wrong": 1,
    "wrong_share_upper": 0.24,
    "outside_accepted": 0,
    "outside_share_upper": 0.18,
}


def rig(**changed):
    return RigCorrection.model_validate(RIG | changed)


def test_the_formula_by_hand(calibration_of):
    """Log odds of 4 become 0.5 x 4 - 1 = 1, so the confidence is e / (1 + e) = 0.731."""
    calibration = calibration_of(right={"terms": [], "bias": 4.0}, rig=RIG)
    assert float(calibration.confidence(np.zeros(len(FEATURES)))) == pytest.approx(0.7310586)
    np.testing.assert_allclose(rig().corrected(np.array([0.0, 2.0, -2.0])), [-1, 0, -2])


def test_a_correction_that_may_only_lower_leaves_what_it_would_raise():
    """0.5 x -4 + 0 = -2 is more than -4. 0.5 x 4 = 2 is less than 4."""
    np.testing.assert_allclose(rig(offset=0, lower_only=True).corrected(np.array([-4.0, 4.0])), [-4, 2])


def test_the_correction_of_the_rig_comes_after_that_of_the_site(calibration_of):
    """0.5 x (4 - 1) - 1 = 0.5."""
    site = {"offset": -1.0, "queries": 10, "right": 5, "expected_calibration_error": 0.0}
    calibration = calibration_of(right={"terms": [], "bias": 4.0}, rig=RIG, site=site)
    assert float(calibration.confidence(np.zeros(len(FEATURES)))) == pytest.approx(float(probability(np.array(0.5))))


def test_a_file_without_the_field_has_no_correction(calibration_json):
    document = calibration_json()
    del document["rig"]
    found = read_calibration(json.dumps(document).encode(), path="x")
    assert found is not None
    assert found.rig is None


@pytest.mark.parametrize(
    "changed",
    [{"scale": 0.1}, {"scale": float("nan")}, {"frames": -1}, {"wrong_share_upper": 1.2}, {"source": "guess"}],
)
def test_a_correction_that_makes_no_sense_is_refused(changed):
    with pytest.raises(ValidationError):
        rig(**changed)


@given(st.lists(st.floats(-30, 30), min_size=2, max_size=50), st.floats(0.2, 5), st.floats(-10, 10), st.booleans())
def test_no_correction_inverts_the_order_of_two_answers(odds, scale, offset, lower_only):
    given_odds = np.sort(np.array(odds))
    confidence = probability(rig(scale=scale, offset=offset, lower_only=lower_only).corrected(given_odds))
    assert (np.diff(confidence) >= 0).all()


def test_an_answer_raised_above_the_odds_of_being_in_the_map_gains_from_a_prior(calibration_of):
    """Log odds of 0 become 2. The model ``known`` still says -2, but a right answer is in the map."""
    flat = {"terms": []}
    calibration = calibration_of(
        right=flat | {"bias": 0.0}, known=flat | {"bias": -2.0}, rig=RIG | {"scale": 1, "offset": 2}
    )
    evidence = np.zeros(len(FEATURES))
    without, with_prior = (decide(calibration, evidence, 0.01, prior_nats=nats).confidence for nats in (0.0, 1.0))
    assert without == pytest.approx(float(probability(np.array(2.0))))
    assert with_prior == pytest.approx(float(probability(np.array(3.0))))
    # Without a correction for a rig, log odds of 0 become 1.
    plain = calibration_of(right=flat | {"bias": 0.0}, known=flat | {"bias": -2.0})
    assert decide(plain, evidence, 0.01, prior_nats=1.0).confidence == pytest.approx(float(probability(np.array(1.0))))


KEY = {"width": 640, "height": 480, "fx": 320.0, "fy": 320.0, "cx": 319.5, "cy": 239.5}
WIDE = KEY | {"fx": 200.0, "fy": 200.0}


def key(**changed):
    return RigKey.model_validate(KEY | changed)


def made_for(name, camera, **changed):
    """Return a correction as it is stored. Its offset tells it from others."""
    return RIG | {"name": name, "made_for": camera} | changed


def chosen(calibration, *asking):
    found = calibration.for_rigs(asking)
    assert found.rigs == ()
    return None if found.rig is None else found.rig.name


def test_each_rig_gets_its_own_correction_and_a_third_rig_none(calibration_of):
    """Log odds of 4 become 0.5 x 4 - 1 = 1 for the first rig and 0.5 x 4 - 2 = 0 for the second."""
    rigs = [made_for("narrow", KEY), made_for("wide", WIDE, offset=-2.0)]
    calibration = calibration_of(right={"terms": [], "bias": 4.0}, rigs=rigs)
    odds = {"narrow": 1.0, "wide": 0.0, None: 4.0}
    for camera, name in ((KEY, "narrow"), (WIDE, "wide"), (KEY | {"fx": 260.0}, None)):
        found = calibration.for_rigs([RigKey.model_validate(camera)])
        assert chosen(calibration, RigKey.model_validate(camera)) == name
        confidence = float(found.confidence(np.zeros(len(FEATURES))))
        assert confidence == pytest.approx(float(probability(np.array(odds[name]))))


def test_a_calibration_without_rigs_is_the_same_object_for_every_query(calibration_of):
    for calibration in (calibration_of(), calibration_of(rig=RIG)):
        assert calibration.for_rigs([key()]) is calibration


def test_the_correction_of_an_earlier_release_applies_where_no_rig_has_one(calibration_of):
    calibration = calibration_of(rig=RIG, rigs=[made_for("wide", WIDE)])
    assert chosen(calibration, key()) == "unnamed"
    assert chosen(calibration, RigKey.model_validate(WIDE)) == "wide"


def test_all_images_of_a_query_must_be_of_the_rig(calibration_of):
    calibration = calibration_of(rigs=[made_for("narrow", KEY), made_for("wide", WIDE)])
    assert chosen(calibration, key(), key()) == "narrow"
    assert chosen(calibration, key(), RigKey.model_validate(WIDE)) is None


def test_what_a_query_does_not_state_counts_only_against_a_correction_from_a_recording(calibration_of):
    stereo = KEY | {"baseline_m": 0.12, "max_range_m": 20.0}
    drive, rendered = made_for("drive", stereo), made_for("rendered", stereo, source="rendered", lower_only=True)
    assert chosen(calibration_of(rigs=[drive]), key()) is None
    assert chosen(calibration_of(rigs=[rendered]), key()) == "rendered"
    for each in (drive, rendered):
        full = key(baseline_m=0.12, max_range_m=20.0)
        assert chosen(calibration_of(rigs=[each]), full) == each["name"]
        assert chosen(calibration_of(rigs=[each]), key(baseline_m=0.3, max_range_m=20.0)) is None
    # Without a baseline the correction is for another depth sensor.
    assert chosen(calibration_of(rigs=[made_for("tof", KEY, source="rendered")]), key(baseline_m=0.12)) is None


@pytest.mark.parametrize("turned", [False, True])
def test_of_several_corrections_the_one_that_suits_best_applies(calibration_of, turned):
    """First a recording, then the most that both state, then the nearest, then the last one."""
    short, long = (
        made_for(name, KEY | {"max_range_m": limit}, source="rendered")
        for name, limit in (("short", 5.0), ("long", 20.0))
    )
    near = made_for("near", KEY | {"fx": 318.0, "max_range_m": 5.0}, source="rendered")
    drive = made_for("drive", KEY | {"fx": 310.0})

    def of(*rigs):
        return calibration_of(rigs=rigs[::-1] if turned else rigs)

    assert chosen(of(short, long), key(max_range_m=20.0)) == "long"
    assert chosen(of(short, near), key()) == "short"
    assert chosen(of(near, drive), key()) == "drive"
    assert chosen(of(short, long), key()) == ("short" if turned else "long")


def test_a_correction_in_the_list_must_say_its_rig(calibration_json):
    with pytest.raises(BundleError, match=r"rigs\.0: made_for is missing"):
        read_calibration(json.dumps(calibration_json(rigs=[RIG])).encode(), path="x")


def test_files_of_earlier_releases_keep_their_bytes(calibration_json):
    """A map without a correction for a rig, and one with the correction of an earlier release, are written as they were."""
    for document in (calibration_json(), calibration_json(rig=RIG)):
        found = read_calibration(json.dumps(document).encode(), path="x")
        assert found is not None
        assert json.loads(found.model_dump_json()) == document
        assert found.model_dump(mode="json") == document


def test_a_list_of_corrections_is_read_as_it_was_written(calibration_json):
    thresholds = [{"false_accept_rate": 0.05, "confidence": 0.8}]
    document = calibration_json(
        rigs=[made_for("a", KEY | {"baseline_m": None, "max_range_m": 5.0}, thresholds=thresholds)]
    )
    found = read_calibration(json.dumps(document).encode(), path="x")
    assert found is not None
    assert json.loads(found.model_dump_json()) == document
    assert found.rigs[0].made_for == key(max_range_m=5.0)


OF_RIG = [{"false_accept_rate": 0.05, "confidence": 0.8}, {"false_accept_rate": 0.1, "confidence": 0.3}]


@pytest.mark.parametrize(
    ("rate", "of_map", "expected"),
    [
        (0.05, 0.6, (0.05, 0.8)),  # the recording supports the rate
        (0.07, 0.6, (0.05, 0.8)),
        (0.1, 0.6, (0.1, 0.5)),
        (0.01, 0.6, (0.05, 0.8)),  # it does not: the stricter of both, with its rate
        (0.01, 0.9, (0.01, 0.9)),
    ],
)
def test_the_thresholds_of_a_recording_replace_those_of_the_map(calibration_of, rate, of_map, expected):
    thresholds = [{"false_accept_rate": 0.01, "confidence": of_map}]
    calibration = calibration_of(thresholds=thresholds, rigs=[made_for("a", KEY, thresholds=OF_RIG)])
    found = calibration.for_rigs([key()]).threshold_at(rate)
    assert (found.false_accept_rate, found.confidence) == expected
    other = calibration.for_rigs([RigKey.model_validate(WIDE)])
    assert other.threshold(rate) == of_map
    assert (calibration.for_rigs([key()]).least_rate_of_rig, other.least_rate_of_rig) == (0.05, None)


def test_thresholds_of_a_rig_that_do_not_rise_are_refused():
    with pytest.raises(ValidationError, match="thresholds must be sorted"):
        rig(thresholds=OF_RIG[::-1])


def rig_in(bundle):
    calibration = MapBundle.open(bundle).calibration
    assert calibration is not None
    return calibration.rig


@pytest.fixture
def calibrated(content_of, calibration_json, tmp_path):
    folder = tmp_path / "town"
    write_bundle(folder, content_of(calibration=calibration_json()))
    return folder


def test_the_calibration_of_a_bundle_is_replaced_and_all_else_stays(calibrated, calibration_json):
    before = MapBundle.open(calibrated)
    inode = (calibrated / "places.npy").stat().st_ino
    made = replace_calibration(calibrated, calibration_json(rig=RIG))
    after = MapBundle.open(calibrated)
    assert after.calibration is not None
    assert after.calibration.rig == rig()
    assert after.manifest == made
    assert made.version != before.manifest.version
    assert made.made_at > before.manifest.made_at
    unchanged = {name: entry for name, entry in made.files.items() if name != "calibration.json"}
    assert unchanged == {name: entry for name, entry in before.manifest.files.items() if name != "calibration.json"}
    assert (calibrated / "places.npy").stat().st_ino == inode
    assert [path.name for path in calibrated.parent.iterdir()] == ["town"]


def test_a_process_with_the_old_bundle_open_keeps_it(calibrated, calibration_json):
    before = MapBundle.open(calibrated)
    places = np.array(before.T_map_place)
    replace_calibration(calibrated, calibration_json(rig=RIG))
    np.testing.assert_array_equal(before.T_map_place, places)


def test_files_are_copied_where_there_are_no_hard_links(calibrated, calibration_json, monkeypatch):
    def refused(*_):
        raise OSError(errno.EPERM, os.strerror(errno.EPERM))

    monkeypatch.setattr(os, "link", refused)
    replace_calibration(calibrated, calibration_json(rig=RIG))
    assert rig_in(calibrated) == rig()


def test_a_link_to_a_bundle_stays_a_link(calibrated, calibration_json, tmp_path):
    link = tmp_path / "current"
    link.symlink_to(calibrated)
    replace_calibration(link, calibration_json(rig=RIG))
    assert link.is_symlink()
    assert rig_in(calibrated) == rig()


@pytest.mark.parametrize("failing", ["sync", "sha256_of"])
def test_a_full_disk_leaves_the_old_bundle(calibrated, calibration_json, monkeypatch, failing):
    version = MapBundle.open(calibrated).manifest.version

    def full(_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(writer, failing, full)
    with pytest.raises(BundleError, match=r"the calibration cannot be replaced \(No space left on device\)"):
        replace_calibration(calibrated, calibration_json(rig=RIG))
    monkeypatch.undo()
    assert MapBundle.open(calibrated).manifest.version == version
    assert [path.name for path in calibrated.parent.iterdir()] == ["town"]


def test_ctrl_c_between_both_renames_brings_the_old_bundle_back(calibrated, calibration_json, monkeypatch):
    version, rename = MapBundle.open(calibrated).manifest.version, type(calibrated).rename

    def interrupted(source, target):
        if source.name.endswith(".partial"):
            raise KeyboardInterrupt
        return rename(source, target)

    monkeypatch.setattr(type(calibrated), "rename", interrupted)
    with pytest.raises(KeyboardInterrupt):
        replace_calibration(calibrated, calibration_json(rig=RIG))
    monkeypatch.undo()
    assert MapBundle.open(calibrated).manifest.version == version
    assert [path.name for path in calibrated.parent.iterdir()] == ["town"]


def test_a_killed_process_leaves_the_old_bundle(calibrated):
    version = MapBundle.open(calibrated).manifest.version
    program = textwrap.dedent(
        """
        import os, signal, sys
        from pathlib import Path
        from service.maps import writer

        writer._put_in_place = lambda partial, out: os.kill(os.getpid(), signal.SIGKILL)
        writer.replace_calibration(Path(sys.argv[1]), {"calibrated": False, "why": "a test"})
        """
    )
    assert subprocess.run([sys.executable, "-c", program, str(calibrated)], check=False).returncode == -9
    assert MapBundle.open(calibrated).manifest.version == version
    assert all(child.name.endswith(".partial") for child in calibrated.parent.iterdir() if child != calibrated)


def test_a_correction_without_ranges_keeps_the_bytes_of_an_earlier_release(calibration_of):
    calibration = calibration_of(rigs=[made_for("a", KEY)])
    assert "ranges" not in json.loads(calibration.model_dump_json())["rigs"][0]
    ranges = [{"feature": "log_noise", "least": -8.0, "most": -3.0}]
    widened = calibration_of(rigs=[made_for("a", KEY, ranges=ranges)])
    assert json.loads(widened.model_dump_json())["rigs"][0]["ranges"] == ranges


def test_a_range_whose_ends_are_swapped_is_refused(calibration_of):
    ranges = [{"feature": "log_noise", "least": -3.0, "most": -8.0}]
    with pytest.raises(ValidationError, match="log_noise: least is larger than most"):
        calibration_of(rigs=[made_for("a", KEY, ranges=ranges)])
