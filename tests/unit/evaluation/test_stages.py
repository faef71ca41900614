"""Each stage of an answer against the ground truth."""

import json
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

from model_training.cli.stages_table import print_stages
from model_training.evaluation.predict import predict
from model_training.evaluation.stages import Lost, QueryStages, loses, lost_by_stage, stages_of
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
