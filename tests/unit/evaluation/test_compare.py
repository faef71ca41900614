"""Two saved runs against each other."""

from dataclasses import replace
from pathlib import Path

import pytest

from model_training.evaluation.compare import compare
from model_training.evaluation.saved_run import SavedRun
from service.errors import DatasetError


@pytest.fixture
def run_of(saved_run):
    """A run with other answers, one set or several."""

    def made(name, **predictions):
        return replace(SavedRun.open(saved_run), folder=Path(name), predictions=predictions)

    return made


def answered(answers_of, *errors_m, first_x=0.0):
    true = [[first_x + 100.0 * k, 0.0] for k in range(len(errors_m))]
    return answers_of(true, [[x, error] for (x, _), error in zip(true, errors_m, strict=True)])


def test_queries_that_changed_sides_are_named(run_of, answers_of):
    found = compare(run_of("a", x=answered(answers_of, 0.1, 9, 9)), run_of("b", x=answered(answers_of, 9, 0.1, 9)))
    assert (found.lost, found.gained) == ([0], [1])
    assert "1 of 3 queries are won and 1 lost: +0.0 points" in found.verdict


def test_few_changes_are_called_chance_and_many_are_not(run_of, answers_of):
    a, same = answered(answers_of, *[9] * 20), answered(answers_of, *[9] * 20)
    five, six = answered(answers_of, *[0.1] * 5, *[9] * 15), answered(answers_of, *[0.1] * 6, *[9] * 14)
    assert compare(run_of("a", x=a), run_of("b", x=five)).verdict.startswith("No difference can be told from chance")
    assert compare(run_of("a", x=a), run_of("b", x=six)).verdict.startswith("B is better than A")
    assert compare(run_of("a", x=six), run_of("b", x=a)).verdict.startswith("B is worse than A")
    assert compare(run_of("a", x=a), run_of("b", x=same)).verdict.startswith(
        "No difference: A and B are right about the same"
    )


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
    with pytest.raises(DatasetError, match=r"query set 'x': a .* asked other queries"):
        compare(run_of("a", x=answered(answers_of, 1)), run_of("b", x=answered(answers_of, *errors, **other)))
