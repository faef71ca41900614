"""Comparison of two saved runs."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from model_training.evaluation.compare import compare
from model_training.evaluation.query_mode import QueryMode
from model_training.evaluation.saved_run import SavedRun
from service.errors import DatasetError


@pytest.fixture
def run_of(saved_run):
    """Return a run with other answers, for one set or several."""

    def made(name, **predictions):
        return replace(SavedRun.open(saved_run), folder=Path(name), predictions=predictions)

    return made


def answered(answers_of, *errors_m, first_x=0.0):
    true = [[first_x + 100.0 * k, 0.0] for k in range(len(errors_m))]
    return answers_of(true, [[x, error] for (x, _), error in zip(true, errors_m, strict=True)])


def test_queries_that_changed_sides_are_named(run_of, answers_of):
    found = compare(run_of("a", x=answered(answers_of, 0.1, 9, 9)), run_of("b", x=answered(answers_of, 9, 0.1, 9)))
    assert (found.lost, found.gained) == ([0], [1])
    assert "33.3% of A, 33.3% of B, 1 of 3 queries by B alone, 1 by A alone, +0.0 points" in found.verdict


def judged(answers_of, errors_m, accepted):
    """Return answers with given errors, accepted (1) or not (0)."""
    p = answered(answers_of, *errors_m)
    return replace(p, status=np.where(np.array(accepted, bool), "LOCALIZED", "OUT_OF_MAP"))


def test_few_changes_are_called_chance_and_many_are_not(run_of, answers_of):
    none = judged(answers_of, [9] * 20, [0] * 20)
    five, six = (judged(answers_of, [0.1] * n + [9] * (20 - n), [1] * n + [0] * (20 - n)) for n in (5, 6))
    assert compare(run_of("a", x=none), run_of("b", x=five)).verdict.startswith("No significant difference")
    assert compare(run_of("a", x=none), run_of("b", x=six)).verdict.startswith("B is significantly better than A")
    assert compare(run_of("a", x=six), run_of("b", x=none)).verdict.startswith("B is significantly worse than A")
    assert compare(run_of("a", x=none), run_of("b", x=none)).verdict.startswith(
        "No difference: A and B are right about the same"
    )


@pytest.mark.parametrize(("right", "wrong"), [(7, 17), (7, 1), (20, 1)])
def test_a_run_that_accepts_more_wrong_answers_is_never_called_better(run_of, answers_of, right, wrong):
    """Retrieval alone on a real drive accepts all: seven right, seventeen wrong. The other run accepts nothing."""
    errors = [0.1] * right + [9] * wrong
    none, all_ = judged(answers_of, errors, [0] * len(errors)), judged(answers_of, errors, [1] * len(errors))
    assert not compare(run_of("a", x=none), run_of("b", x=all_)).verdict.startswith("B is better")
    assert not compare(run_of("a", x=all_), run_of("b", x=none)).verdict.startswith("B is worse")
    assert compare(run_of("a", x=none), run_of("b", x=all_)).verdict.startswith(
        "Neither is better: B has more right answers"
    )


def test_more_wrong_answers_accepted_make_a_run_worse_and_fewer_make_it_better(run_of, answers_of):
    errors = [0.1] * 10 + [9] * 10
    careful = judged(answers_of, errors, [1] * 10 + [0] * 10)
    rash = judged(answers_of, errors, [1] * 20)
    assert compare(run_of("a", x=careful), run_of("b", x=rash)).verdict.startswith("B is significantly worse than A")
    assert compare(run_of("a", x=rash), run_of("b", x=careful)).verdict.startswith("B is significantly better than A")


def test_forced_errors_accepted_right_and_accepted_wrong_are_each_paired(run_of, answers_of):
    a = judged(answers_of, [0.4, 0.4, 9, 9] * 5, [1, 0, 1, 0] * 5)
    b = judged(answers_of, [0.1, 0.1, 9, 9] * 5, [1, 1, 0, 0] * 5)
    found = compare(run_of("a", x=a), run_of("b", x=b))
    assert [found.shares["within_1_m"].only_second, found.shares["accepted_but_wrong"].only_first] == [5, 5]
    assert found.shares["forced_within_1_m"].only_first == found.shares["forced_within_1_m"].only_second == 0
    assert found.errors is not None
    assert found.errors.p < 0.01
    assert found.errors.median_difference_m == pytest.approx(-0.15)


def test_rows_are_those_of_the_sets_in_the_first_runs_order(run_of, answers_of):
    right, wrong = answered(answers_of, 0.1, 0.1), answered(answers_of, 0.1, 9)
    assert compare(run_of("a", x=right, y=right), run_of("b", y=wrong, x=right)).lost == [3]


def test_runs_of_other_sets_are_refused_with_their_names(run_of, answers_of):
    p = answered(answers_of, 1)
    with pytest.raises(DatasetError, match="only one has night; evaluate both with the same --queries"):
        compare(run_of("a", x=p), run_of("b", x=p, night=p))


@pytest.mark.parametrize("other", [{"errors": (1, 1)}, {"errors": (1,), "first_x": 0.01}])
def test_runs_over_other_queries_are_refused(run_of, answers_of, other):
    errors = other.pop("errors")
    with pytest.raises(DatasetError, match=r"query set 'x': a .* have different queries"):
        compare(run_of("a", x=answered(answers_of, 1)), run_of("b", x=answered(answers_of, *errors, **other)))


def in_mode(run, **mode):
    return replace(run, settings=run.settings.model_copy(update={"mode": QueryMode(**mode)}))


def test_a_comparison_says_what_each_run_measured(run_of, answers_of):
    answers = answered(answers_of, 0.1, 9)
    found = compare(run_of("a", x=answers), in_mode(run_of("b", x=answers), prior_std_m=3))
    assert found.modes == ("single images", "single images, prior of 3 m")
    assert found.as_json()["modes"] == ["single images", "single images, prior of 3 m"]


def test_queries_of_another_number_of_images_are_refused(run_of, answers_of):
    answers = answered(answers_of, 0.1, 9)
    with pytest.raises(
        DatasetError,
        match=r"a measured single images, and b 5 consecutive images .* evaluate both with the same --frames",
    ):
        compare(run_of("a", x=answers), in_mode(run_of("b", x=answers), frames=5))
