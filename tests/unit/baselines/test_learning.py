from pathlib import Path

import pytest
import torch

from model_training.baselines.learning import Training
from service.errors import DatasetError


def spend(training: Training, seconds: float) -> None:
    """Processor time of this thread, not of the wall."""
    until = training.processor_s + seconds
    while training.processor_s < until:
        sum(range(2000))


def test_the_budget_is_of_processor_time_and_ends_the_run(tmp_path: Path) -> None:
    training = Training(tmp_path, {"a": 1}, budget_s=0.05)
    assert training.ended is None

    training.point(10, 1.0, 0.5, {"x": 1})
    spend(training, 0.06)

    assert training.share_spent == 1.0
    assert training.ended == "budget"


def test_a_run_goes_on_with_what_it_has_spent(tmp_path: Path) -> None:
    first = Training(tmp_path, {"a": 1}, budget_s=10.0)
    spend(first, 0.05)
    point = first.point(128, 0.7, 0.6, {"net": {"w": torch.ones(2)}})

    again = Training(tmp_path, {"a": 1}, budget_s=10.0)

    assert again.images == 128
    assert again.processor_s >= point.processor_s
    assert again.curve == [point]
    state = again.checkpoint()
    assert state is not None
    assert state["net"]["w"].tolist() == [1.0, 1.0]


def test_the_best_state_is_kept_apart_from_the_last(tmp_path: Path) -> None:
    training = Training(tmp_path, {}, budget_s=10.0)
    for number, score in enumerate((0.2, 0.9, 0.4)):
        training.point(number, 0.0, score, {"number": number})

    state = training.checkpoint()
    assert state is not None
    assert state["number"] == 2
    assert training.best()["number"] == 1


@pytest.mark.parametrize(
    ("scores", "ended"),
    [
        ((0.1, 0.5, 0.4, 0.5, 0.45), "stopped gaining"),  # none of the last three is better than the second
        ((0.1, 0.5, 0.4, 0.5, 0.51), None),
        ((0.5, 0.4, 0.3), None),  # too few to tell
    ],
)
def test_a_run_ends_when_its_score_stops_gaining(tmp_path: Path, scores: tuple[float, ...], ended: str | None) -> None:
    training = Training(tmp_path, {}, budget_s=100.0, patience=3)

    for number, score in enumerate(scores):
        training.point(number, 0.0, score, {})

    assert training.ended == ended


def test_a_folder_of_other_settings_is_refused(tmp_path: Path) -> None:
    Training(tmp_path, {"rate": 0.1}, budget_s=1.0)

    with pytest.raises(DatasetError, match="is of other settings; remove"):
        Training(tmp_path, {"rate": 0.2}, budget_s=1.0)


def test_there_is_no_best_state_before_the_first_point(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"holds no best\.pt yet"):
        Training(tmp_path, {}, budget_s=1.0).best()
