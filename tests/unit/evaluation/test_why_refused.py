"""Advice if almost no answer is accepted, for simulated queries with wrong metadata."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from model_training.datasets.dataset import Dataset
from model_training.evaluation.predict import predict
from model_training.evaluation.why_refused import causes, out_of_range
from model_training.mapping.cloud import SURVEYED_HEIGHT
from service.confidence.features import FEATURES
from service.localization.localizer import Localizer
from service.maps.reader import MapBundle

NAME = "drive1_precise"


@pytest.fixture(scope="module")
def localizer(small_map):
    """Return a localizer that registers all depth.

    The encoder of this map is a random projection, so only the inlier share tells a wrong focal length. With a limit of the height, a
    shorter focal length omits more points, and the share of the others may rise. With the stock encoder, the limit makes it easier to
    name a wrong focal length (decision 0177).
    """
    bundle = MapBundle.open(small_map)
    others = {name: value for name, value in bundle.manifest.parameters.items() if name != SURVEYED_HEIGHT}
    return Localizer.open(replace(bundle, manifest=bundle.manifest.model_copy(update={"parameters": others})))


@pytest.fixture
def told_wrong(small_dataset, tmp_path):
    """Return the small dataset with a description that has wrong intrinsics or a wrong depth unit."""

    def made(*, focal=1.0, depth=1.0):
        folder = shutil.copytree(small_dataset.folder, tmp_path / f"{focal}-{depth}")
        description = json.loads((folder / "dataset.json").read_text())
        for camera in description["sensors"]["cameras"]:
            camera["fx"], camera["fy"] = camera["fx"] * focal, camera["fy"] * focal
            camera["depth"]["scale_m"] *= depth
        (folder / "dataset.json").write_text(json.dumps(description))
        return Dataset(folder)

    return made


def refused(localizer, dataset):
    answers = predict(localizer, dataset, NAME)
    answers.status[:] = "OUT_OF_MAP"
    return list(dataset.queries(NAME)), answers


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ({"focal": 2.0}, "the focal length is off by a factor of two: fx and fy times 0.5 fit the map"),
        ({"depth": 10.0}, "the depth unit is off: depth times 0.1 fits the map"),
        ({"depth": 0.001}, "the depth unit is off: depth times 1000 fits the map"),
    ],
)
def test_a_wrong_focal_length_and_a_wrong_unit_are_named(localizer, told_wrong, wrong, told):
    assert causes(localizer, *refused(localizer, told_wrong(**wrong)))[0].what == told


def test_right_intrinsics_and_units_are_not_suspected(localizer, small_dataset):
    assert causes(localizer, *refused(localizer, small_dataset)) == []


def test_with_enough_accepted_answers_there_is_no_advice(localizer, small_dataset):
    frames, answers = refused(localizer, small_dataset)
    answers.status[:] = "LOCALIZED"
    assert causes(localizer, frames, answers) == []


def test_evidence_out_of_range_is_named_in_the_order_of_likelihood(calibration_of):
    calibration = calibration_of()
    evidence = np.tile([each.mean for each in calibration.features], (5, 1))
    assert out_of_range(calibration, evidence) == []
    for name, deviations in (("margin", -5), ("log_noise", 5), ("through", 5)):
        evidence[:, FEATURES.index(name)] += deviations * calibration.features[FEATURES.index(name)].std
    told = out_of_range(calibration, evidence)
    assert [each.what.split(" (")[0] for each in told] == ["baseline", "traffic in the map", "calibration"]
    assert "log_noise +5.0" in told[0].what


def test_evidence_better_than_the_calibration_data_is_no_reason(calibration_of):
    calibration = calibration_of()
    evidence = np.tile([each.mean for each in calibration.features], (5, 1))
    for name, deviations in (("margin", 5), ("static_inliers", 5), ("contrast", 5), ("through", -5)):
        evidence[:, FEATURES.index(name)] += deviations * calibration.features[FEATURES.index(name)].std
    assert out_of_range(calibration, evidence) == []


def test_answers_without_evidence_speak_of_depth(calibration_of):
    (cause,) = out_of_range(calibration_of(), np.full((3, len(FEATURES)), np.nan))
    assert "depth" in cause.what
