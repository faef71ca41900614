"""Each stage of an answer against the ground truth."""

import json
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

from model_training.cli.stages_table import print_stages
from model_training.evaluation import stages
from model_training.evaluation.predict import predict
from model_training.evaluation.stages import Lost, QueryStages, loses, lost_by_stage, stages_of
from service.localization import refine
from service.localization.localizer import Localizer
from service.maps.reader import MapBundle

NAME = "drive1_precise"
GOOD = QueryStages(
    number=0,
    tilt_deg=0.5,
    height_error_m=0.1,
    rank=1,
    start_m=1.0,
    candidate_m=0.1,
    from_truth_m=0.1,
    error_m=0.1,
    status="LOCALIZED",
)


@pytest.mark.parametrize(
    ("changed", "lost"),
    [
        ({}, Lost.NOT),
        ({"status": "OUT_OF_MAP"}, Lost.STATUS),
        ({"error_m": 2.0}, Lost.CHOICE),
        ({"error_m": 2.0, "tilt_deg": 4.0}, Lost.LEVEL),
        ({"error_m": 2.0, "height_error_m": -0.6}, Lost.LEVEL),
        ({"error_m": 2.0, "candidate_m": 1.5, "from_truth_m": 1.5}, Lost.REGISTRATION),
        ({"error_m": 2.0, "candidate_m": 1.5}, Lost.CANDIDATES),
        ({"error_m": 2.0, "candidate_m": np.inf, "start_m": 9.0, "rank": 0}, Lost.RETRIEVAL),
        ({"error_m": 2.0, "candidate_m": np.inf, "start_m": np.inf, "from_truth_m": 3.0}, Lost.RETRIEVAL),
    ],
)
def test_the_first_stage_that_fails_loses_the_query(changed, lost):
    assert loses(replace(GOOD, **changed)) == lost


def test_stages_are_those_of_the_answers_that_evaluate_measures(small_map, small_dataset):
    localizer = Localizer.open(MapBundle.open(small_map))
    found, answers = stages_of(localizer, small_dataset, NAME), predict(localizer, small_dataset, NAME)
    off_m = np.linalg.norm(answers.T_answer[:, :2, 3] - answers.T_true[:, :2, 3], axis=1)
    np.testing.assert_allclose([each.error_m for each in found], off_m, atol=1e-9)
    assert [each.status for each in found] == answers.status.tolist()
    assert sum(lost_by_stage(found).values()) == len(found) == 5
    # A simulated precise camera on the true map: level and height are right, and the truth is a hollow of registration.
    assert max(each.tilt_deg for each in found) < 3
    assert max(abs(each.height_error_m) for each in found) < 0.5
    assert np.median([each.from_truth_m for each in found]) < 0.5
    assert np.median([each.inliers_at_truth for each in found]) > 0.3


def localizer_of(folder, **parameters):
    bundle = MapBundle.open(folder)
    manifest = bundle.manifest.model_copy(update={"parameters": bundle.manifest.parameters | parameters})
    localizer = Localizer.open(bundle)
    return Localizer(replace(bundle, manifest=manifest), localizer.encoder)


def test_the_stages_register_the_points_that_the_service_registers(small_map, small_dataset, monkeypatch):
    """The service omits points above the surveyed height (here 2 m). The row of inliers at the true pose once counted them."""
    registered = {"service": [], "stages": []}
    for name, module in (("service", refine), ("stages", stages)):

        def recorded(cloud, points, *rest, name=name, register=module.register):
            registered[name].append(points.xyz)
            return register(cloud, points, *rest)

        monkeypatch.setattr(module, "register", recorded)
    found = {
        high: stages_of(localizer_of(small_map, surveyed_height_m=high), small_dataset, NAME) for high in (2.0, 90.0)
    }
    assert len(registered["service"]) == len(registered["stages"]) == 10
    for served, staged in zip(registered["service"], registered["stages"], strict=True):
        np.testing.assert_array_equal(served, staged)
    assert all(
        len(low) < len(high) for low, high in zip(registered["stages"][:5], registered["stages"][5:], strict=True)
    )
    assert [each.inliers_at_truth for each in found[2.0]] != [each.inliers_at_truth for each in found[90.0]]


def test_an_exact_noise_model_predicts_the_mean_weight_of_the_points_with_a_surface(
    small_map, small_dataset, monkeypatch
):
    """Of the points 0.8 have a surface. The mean of exp(-x^2 / 2) over the normal distribution is 0.7071."""

    def score(_cloud, _points, state, _height_m, settings):
        state["inliers"] = 0.8 if settings.tolerance_m > 1000 else 0.3

    monkeypatch.setattr(stages, "score", score)
    found = stages_of(Localizer.open(MapBundle.open(small_map)), small_dataset, NAME)
    assert {(each.inliers_at_truth, round(each.inliers_predicted, 4)) for each in found} == {(0.3, 0.5657)}


def test_points_of_a_precise_camera_have_about_the_predicted_share_of_inliers(small_map, small_dataset):
    found = stages_of(Localizer.open(MapBundle.open(small_map)), small_dataset, NAME)
    predicted = [each.inliers_predicted for each in found]
    assert max(predicted) <= stages.EXACT_INLIERS + 1e-9
    assert np.median(predicted) > 0.4


def test_numbers_that_are_not_finite_are_null_in_json():
    assert json.loads(json.dumps(QueryStages(number=3).as_json(), allow_nan=False))["start_m"] is None


def test_the_table_names_the_stage_and_counts_it(capsys):
    print_stages(
        "drive",
        [replace(GOOD, lost=Lost.NOT), replace(GOOD, status="OUT_OF_MAP", lost=Lost.STATUS)],
        Console(width=200),
    )
    told = capsys.readouterr().out
    assert "OUT_OF_MAP" in told
    assert "1 of 2 lost by status" in told
