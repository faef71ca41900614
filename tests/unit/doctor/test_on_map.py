import json
from dataclasses import replace

import numpy as np
import pytest

from service.confidence.reasons import Reason
from service.contract.schema import LocalizeRequest
from service.doctor import on_map
from service.doctor.on_map import answer_of, check_answer, check_rows, rows_of_camera
from service.doctor.pair import check_images, encoded_of
from service.localization.localizer import Localizer
from service.maps.reader import MapBundle
from service.maps.writer import write_bundle
from service.runtime.engine import Engine
from service.runtime.settings import Settings

ELEVATIONS_RAD = np.deg2rad(np.array([15.0, 5.0, -5.0, -15.0]))


@pytest.fixture
def localizer(bundle_path):
    return Localizer.open(MapBundle.open(bundle_path))


@pytest.fixture
def pair(parts_of):
    parts = parts_of()
    request = LocalizeRequest.model_validate(json.loads(parts["request"]))
    return check_images(encoded_of(request, parts["rgb"], parts["depth"]))[1]


def test_the_camera_sees_the_rows_within_its_field_of_view(pair, localizer):
    """24 px above and below the centre at a focal length of 32 px are 37 degrees. The grid ends at 15 degrees."""
    assert rows_of_camera(pair, localizer.bundle).tolist() == [True] * 8


def test_a_narrow_camera_sees_fewer_rows(pair, localizer):
    """With fy = 200 px the image ends 6.8 degrees above and below. The rows are at 2.1, 6.4, 10.7 and 15 degrees."""
    camera = replace(pair.encoded.camera, fy=200.0)
    narrow = replace(pair, encoded=replace(pair.encoded, camera=camera, down_camera=np.array([0.0, 1.0, 0.0])))
    assert rows_of_camera(narrow, localizer.bundle).tolist() == [False, False, True, True, True, True, False, False]


@pytest.mark.parametrize(
    ("camera", "lidar", "level", "share"),
    [
        ([1, 1, 1, 1], [0, 0, 1, 1], "ok", "50%"),
        ([1, 1, 1, 0], [0, 0, 1, 1], "warning", "33%"),
        ([1, 1, 0, 0], [0, 0, 1, 1], "warning", "0%"),
    ],
)
def test_the_lidar_must_see_half_of_the_cameras_rows(camera, lidar, level, share):
    found = check_rows(np.array(camera, bool), np.array(lidar, bool), ELEVATIONS_RAD)
    assert found.level == level
    assert found.text.startswith(f"the LiDAR of the survey covers {share} of the rows that the camera covers (camera ")
    assert found.text.endswith("LiDAR -15 to -5 degrees)")


def test_a_camera_that_sees_nothing_of_the_grid_is_a_warning():
    found = check_rows(np.zeros(4, bool), np.ones(4, bool), ELEVATIONS_RAD)
    assert (found.level, found.text) == ("warning", "the camera covers no row of the view grid of the map")


def test_the_answer_is_that_of_the_service(pair, localizer, bundle_path):
    engine = Engine.open(Settings(maps=(bundle_path,)))
    served = engine.localize(pair.encoded).answer
    engine.close()
    found = answer_of(pair, localizer, 0.02)
    assert found.status == served.status
    np.testing.assert_array_equal(found.T_map_camera_guess, served.T_map_camera_guess)
    told = check_answer(pair, localizer, 0.02)
    assert (told.level, told.text) == ("ok", "LOCALIZED (no confidence)")


def test_an_answer_that_is_not_localized_is_a_warning_with_its_reasons(pair, content_of, calibration_json, tmp_path):
    """The log odds of 0.5 and 0.75 give a confidence below the threshold of 0.9."""
    write_bundle(tmp_path / "own", content_of(calibration=calibration_json()))
    localizer = Localizer.open(MapBundle.open(tmp_path / "own"))
    told = check_answer(pair, localizer, 0.001)
    answer = answer_of(pair, localizer, 0.001)
    assert (told.level, answer.status == "LOCALIZED") == ("warning", False)
    assert told.text == f"{answer.status} (confidence {answer.confidence:.3f})"
    assert answer.reasons
    assert all(each.remedy in told.remedy for each in answer.reasons)


def test_a_confidence_that_is_extrapolated_is_a_warning(pair, localizer, monkeypatch):
    answer = replace(answer_of(pair, localizer, 0.02), confidence=0.95, extrapolated=(("front", 5.04),))
    monkeypatch.setattr(on_map, "answer_of", lambda *_: answer)
    told = check_answer(pair, localizer, 0.02)
    assert (told.level, "front +5.0 standard deviations" in told.text) == ("warning", True)
    assert "calibrate" in told.remedy


@pytest.mark.parametrize("reasons", [(), (Reason("baseline", (("log_noise", 2.8),), "check the stereo baseline"),)])
def test_an_answer_that_is_refused_because_it_is_extrapolated_says_so(pair, localizer, monkeypatch, reasons):
    outside = (("log_noise", 2.76),)
    found = replace(
        answer_of(pair, localizer, 0.01), status="AMBIGUOUS", confidence=0.99, extrapolated=outside, reasons=reasons
    )
    monkeypatch.setattr(on_map, "answer_of", lambda *_: found)
    told = check_answer(pair, localizer, 0.01)
    assert told.text.startswith("AMBIGUOUS (confidence 0.990), extrapolated: log_noise +2.8 standard deviations")
    assert "calibrate --map --drive" in told.remedy
    assert ("check the stereo baseline" in told.remedy) == bool(reasons)


def test_the_correction_for_the_rig_is_named(pair, localizer, monkeypatch):
    answer = replace(answer_of(pair, localizer, 0.02), confidence=0.95, rig_correction="mule")
    monkeypatch.setattr(on_map, "answer_of", lambda *_: answer)
    assert check_answer(pair, localizer, 0.02).text == "LOCALIZED (confidence 0.950, with the correction for mule)"


def test_a_query_that_the_service_refuses_is_a_problem(pair, localizer):
    wgs84 = replace(pair, encoded=replace(pair.encoded, prior_wgs84=(52.5, 13.4), prior=_prior()))
    told = check_answer(wgs84, localizer, 0.02)
    assert (told.level, told.remedy) == ("problem", "send prior.position in the map frame")


def _prior():
    from service.retrieval.prior import Prior

    return Prior(position_std_m=5.0)
