"""The stage at which a query was lost."""

import numpy as np
import pytest

from model_training.evaluation.failures import WHY, Stage, position_errors, stages, worst
from model_training.evaluation.predict import CANDIDATES, RANKED

NAN = float("nan")


def one(answers_of, answer_x, *, status="LOCALIZED", ranked_x=NAN, candidate_x=NAN):
    ranked, candidates = np.full((1, RANKED, 2), NAN), np.full((1, CANDIDATES, 4), NAN)
    ranked[0, 9], candidates[0, 1] = (ranked_x, 0.0), (candidate_x, 0.0, 0.0, 1.0)
    candidates[0, 0] = (candidate_x + 300.0, 0.0, 0.0, 2.0)
    return answers_of([[0, 0]], [[answer_x, 0.0]], status=[status], ranked_xy=ranked, candidates=candidates)


@pytest.mark.parametrize(
    ("asked", "stage"),
    [
        ({"answer_x": 0.9}, Stage.RIGHT),
        ({"answer_x": 0.9, "status": "AMBIGUOUS"}, Stage.DOUBTED),
        ({"answer_x": 4.9}, Stage.IMPRECISE),
        ({"answer_x": 40, "ranked_x": 4.0, "candidate_x": 4.0}, Stage.ELSEWHERE),
        ({"answer_x": 40, "ranked_x": 90.0, "candidate_x": 4.0}, Stage.ELSEWHERE),
        ({"answer_x": 40, "ranked_x": 4.0, "candidate_x": 40.0}, Stage.STARTS),
        ({"answer_x": 40, "ranked_x": 6.0, "candidate_x": 40.0}, Stage.RETRIEVAL),
        ({"answer_x": 40, "ranked_x": 4.0}, Stage.ELSEWHERE),  # nothing was registered
        ({"answer_x": NAN, "status": ""}, Stage.REFUSED),
    ],
)
def test_the_stage_that_lost_it(answers_of, asked, stage):
    assert stages(one(answers_of, **asked)) == [stage]


def test_every_stage_is_explained():
    assert set(WHY) == set(Stage)


def test_an_accepted_wrong_answer_is_worse_than_a_farther_doubted_one_and_none_is_worse_than_that(answers_of):
    p = answers_of(
        [[0, 0]] * 5,
        [[0.1, 0], [50, 0], [NAN, NAN], [3, 0], [0.7, 0]],
        status=["LOCALIZED", "AMBIGUOUS", "", "LOCALIZED", "LOCALIZED"],
    )
    assert worst(p, 20) == [3, 2, 1, 4, 0]
    assert worst(p, 2) == [3, 2]


def test_an_error_is_infinite_where_there_is_no_answer(answers_of):
    np.testing.assert_allclose(position_errors(answers_of([[0, 0], [1, 1]], [[3, 4], [NAN, NAN]])), [5.0, np.inf])
