import pytest

from model_training.mapping.calibration_file import calibration_for
from model_training.stock import CALIBRATION, ENCODER
from service.errors import BundleError, DatasetError
from service.retrieval.encoder import Encoder

OWN, OTHER = "1" * 64, "2" * 64


def test_the_calibration_of_ones_own_encoder_is_taken(calibration_file_of):
    found = calibration_for(calibration_file_of(OWN), OWN)
    assert found is not None
    assert found.measured_on == {"encoder_sha256": OWN}


def test_that_of_another_encoder_is_none(calibration_file_of):
    assert calibration_for(calibration_file_of(OTHER), OWN) is None


def test_without_a_calibration_file_there_is_no_calibration():
    assert calibration_for(None, OWN) is None


def test_a_file_that_says_there_is_no_calibration_is_none(tmp_path):
    (tmp_path / "c.json").write_text('{"calibrated": false, "why": "not yet"}')
    assert calibration_for(tmp_path / "c.json", OWN) is None


def test_a_calibration_that_does_not_say_whose_it_is_is_none(calibration_file_of, calibration_json, tmp_path):
    path = calibration_file_of(OWN)
    path.write_text(path.read_text().replace("encoder_sha256", "cities"))
    assert calibration_for(path, OWN) is None


@pytest.mark.parametrize("make", [None, "a folder"])
def test_a_file_that_cannot_be_read_is_refused_with_what_makes_one(tmp_path, make):
    if make:
        (tmp_path / "c.json").mkdir()
    with pytest.raises(
        DatasetError, match=r"c\.json cannot be read \(.*\); create it with streetfix calibrate"
    ) as error:
        calibration_for(tmp_path / "c.json", OWN)
    assert error.value.field == "calibration"


def test_a_file_that_is_no_calibration_is_refused(tmp_path):
    (tmp_path / "c.json").write_text("{")
    with pytest.raises(BundleError, match=r"c\.json: not valid JSON"):
        calibration_for(tmp_path / "c.json", OWN)


def test_the_stock_encoder_has_a_calibration_of_its_own():
    assert calibration_for(CALIBRATION, Encoder.open(ENCODER).sha256) is not None
