import pytest

from benchmarks.serving.agreement import Named, Switch, disagreements

SWITCHES = [Switch("b", begun=1.0, done=2.0), Switch("c", begun=5.0, done=6.0), Switch("b", begun=8.0, done=9.0)]


@pytest.mark.parametrize(
    "answers",
    [
        [],
        [Named("a", 0.0, 0.5), Named("b", 3.0, 4.0), Named("c", 7.0, 7.5), Named("b", 10.0, 11.0)],
        [Named("a", 1.2, 1.3), Named("b", 1.4, 1.5), Named("b", 1.6, 1.7)],
        [Named("a", 1.2, 1.6), Named("b", 1.4, 1.5)],  # they overlap: either may have come first
        [Named("a", 0.9, 20.0), Named("c", 0.9, 20.0)],  # a slow answer may be from any moment
    ],
)
def test_answers_that_an_order_of_events_explains_agree(answers: list[Named]) -> None:
    assert disagreements("a", SWITCHES, answers) == []


@pytest.mark.parametrize(
    "answers",
    [
        [Named("b", 0.2, 0.3)],  # before the switch began
        [Named("a", 3.0, 3.1)],  # after it was done
        [Named("x", 3.0, 3.1)],
        [Named("b", 1.2, 1.3), Named("a", 1.4, 1.5)],  # another worker still has the old version
        [Named("a", 1.4, 1.5), Named("b", 1.2, 1.3)],
        [Named("c", 5.1, 5.2), Named("b", 5.3, 5.4)],
    ],
)
def test_an_unexplained_answer_is_a_disagreement(answers: list[Named]) -> None:
    assert len(disagreements("a", SWITCHES, answers)) == 1
