from pathlib import Path
from typing import Any

import pytest
import torch

from research.baselines.learning import Training, cosine_share, rests, set_rate
from service.errors import DatasetError


def spend(training: Training, seconds: float) -> None:
    """Read the fake clock until the seconds have passed."""
    until = training.processor_s + seconds
    while training.processor_s < until:
        pass


def test_the_budget_is_of_processor_time_and_ends_the_run(tmp_path: Path) -> None:
    training = Training(tmp_path, {"a": 1}, budget_s=0.5)
    assert training.ended is None

    training.point(10, 1.0, 0.5, {"x": 1})
    spend(training, 0.6)

    assert training.share_spent == 1.0
    assert training.ended == "budget"


def test_a_run_goes_on_with_what_it_has_spent(tmp_path: Path) -> None:
    first = Training(tmp_path, {"a": 1}, budget_s=10.0)
    spend(first, 0.5)
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


def test_the_count_of_rests_restarts_after_each_rest_and_each_new_best() -> None:
    assert rests([], 2) == 0
    assert rests([0.1, 0.1, 0.1], 2) == 1
    assert rests([0.1, 0.05, 0.2, 0.1], 2) == 0  # a new best in between
    assert rests([0.1, 0.0, 0.0, 0.0, 0.0], 2) == 2
    assert rests([0.1, 0.0, 0.0, 0.3, 0.2, 0.2], 2) == 2


def test_a_run_with_drops_goes_on_after_the_first_rests(tmp_path: Path) -> None:
    training = Training(tmp_path, {}, budget_s=100.0, patience=1, drops=1)
    told = []
    for number, score in enumerate((0.5, 0.4, 0.6, 0.6)):
        training.point(number, 0.0, score, {})
        told.append((training.rests_so_far, training.ended))

    assert told == [(0, None), (1, None), (1, None), (2, "stopped gaining")]


def test_a_folder_of_other_settings_is_refused(tmp_path: Path) -> None:
    Training(tmp_path, {"rate": 0.1}, budget_s=1.0)

    with pytest.raises(DatasetError, match="has other settings; remove"):
        Training(tmp_path, {"rate": 0.2}, budget_s=1.0)


def test_there_is_no_best_state_before_the_first_point(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"has no best\.pt yet"):
        Training(tmp_path, {}, budget_s=1.0).best()


def test_the_rate_rises_to_all_of_it_and_falls_to_a_hundredth() -> None:
    assert cosine_share(0.0, warm_up=0.1) == pytest.approx(0.01)
    assert cosine_share(0.05, warm_up=0.1) == pytest.approx(0.5)
    assert cosine_share(0.1, warm_up=0.1) == pytest.approx(1.0)
    assert cosine_share(0.55, warm_up=0.1) == pytest.approx(0.505)
    assert cosine_share(1.0, warm_up=0.1) == pytest.approx(0.01)
    assert cosine_share(0.0) == pytest.approx(1.0)


def test_a_group_may_have_a_multiple_of_the_rate() -> None:
    one, two = torch.nn.Parameter(torch.zeros(1)), torch.nn.Parameter(torch.zeros(1))
    groups: list[dict[str, Any]] = [{"params": [one]}, {"params": [two], "times": 10.0}]
    optimiser = torch.optim.SGD(groups, lr=1.0)

    set_rate(optimiser, 0.2)

    assert [group["lr"] for group in optimiser.param_groups] == pytest.approx([0.2, 2.0])
