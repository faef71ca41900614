import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from model_training.cli import demo_answers
from model_training.cli.demo_answers import Outcome, ask, print_answers, print_next
from model_training.cli.demo_map import DemoQuery
from service.errors import RefusedError
from service.geometry.rigid import R_BODY_OPTICAL, rotation_z, transform_from

TRUTH = transform_from(rotation_z(np.radians(170)) @ R_BODY_OPTICAL, np.array([10.0, 20.0, 1.5]))
IN_STREET = DemoQuery("1", Path("a.jpg"), Path("a.png"), Path("front.json"), TRUTH, street=("s4", "Street 4"))
OF_PLACE = replace(IN_STREET, street=None, place=2)


def answer_of(*, street: str | None = "s4", place: int = 2) -> dict[str, Any]:
    return {
        "status": "LOCALIZED",
        "confidence": None,
        "street": None if street is None else {"id": street, "name": f"Street {street[1:]}"},
        "pose": {"position": {"x": 13.0, "y": 24.0, "z": 9.0}, "heading_deg": -175.0},
        "neighbours": [{"place": place, "similarity": 0.9}],
        "hypotheses": [],
    }


def outcome_of(question: DemoQuery = IN_STREET, **answer: Any) -> Outcome:
    return Outcome(question, answer_of(**answer), "", 0.05)


def printed(outcomes: list[Outcome], *, places: tuple[str, ...] = ()) -> str:
    stream = io.StringIO()
    print_answers(outcomes, Console(file=stream, width=100), places=places)
    return stream.getvalue()


def test_errors_are_horizontal_and_across_the_half_turn() -> None:
    assert outcome_of().error_m == pytest.approx(5.0)
    assert outcome_of().heading_error_deg == pytest.approx(15.0)


@pytest.mark.parametrize(("street", "right"), [("s4", True), ("s5", False), (None, False)])
def test_the_street_is_right_by_its_id(street: str | None, right: bool) -> None:
    assert outcome_of(street=street).right is right


def test_another_single_place_is_wrong_and_at_no_distance() -> None:
    assert (outcome_of(OF_PLACE).right, outcome_of(OF_PLACE).error_m) == (True, pytest.approx(5.0))
    assert (outcome_of(OF_PLACE, place=1).right, outcome_of(OF_PLACE, place=1).error_m) == (False, None)


def test_a_place_that_the_map_lacks_is_not_counted() -> None:
    elsewhere = replace(OF_PLACE, place=None, T_map_camera=None)
    text = printed([outcome_of(OF_PLACE), outcome_of(elsewhere)], places=("a", "b", "c"))
    assert "1 of 1 first places right" in text
    assert "not in the map" in text


def test_a_refused_query_counts_as_wrong_and_its_problem_is_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise RefusedError("the service refused: No depth")

    monkeypatch.setattr(demo_answers, "localize", refuse)
    text = printed([ask(IN_STREET, "http://127.0.0.1:1"), outcome_of()])
    assert "No depth" in text
    assert "1 of 2 streets right" in text


@pytest.mark.parametrize(
    ("status", "confidence", "wanted"),
    [
        ("LOCALIZED", 0.9871, "LOCALIZED 0.987"),
        ("LOCALIZED", None, "LOCALIZED  "),
    ],
)
def test_an_answers_status_and_confidence_are_shown(status: str, confidence: float | None, wanted: str) -> None:
    answer = answer_of() | {"status": status, "confidence": confidence}
    assert wanted in printed([Outcome(IN_STREET, answer, "", 0.05)])


def test_an_answer_without_a_pose_is_neither_right_nor_wrong_and_its_guess_is_called_forced() -> None:
    guess = {"pose": {"position": {"x": 10.0, "y": 22.0, "z": 9.0}, "heading_deg": -175.0}}
    doubted = answer_of() | {
        "status": "OUT_OF_MAP",
        "confidence": 0.2,
        "pose": None,
        "street": None,
        "hypotheses": [guess],
    }
    refused = Outcome(IN_STREET, doubted, "", 0.05)
    assert (refused.right, refused.error_m, refused.heading_error_deg) == (None, None, None)
    assert refused.forced_error_m == pytest.approx(2.0)
    text = printed([outcome_of(), refused])
    assert "no pose" in text
    assert "(forced 2.00 m)" in text
    assert "1 of 1 streets right\n1 of 2 answers accepted (LOCALIZED); the others have no pose" in text
    assert "accepted answers: position off by 5.00 m (median), 5.00 m (largest); 1 of 1 over 1 m" in text
    assert "forced, whatever the status: position off by 3.50 m (median), 5.00 m (largest); 2 of 2 over 1 m" in text


def test_single_places_have_status_and_confidence_beside_their_error() -> None:
    answer = answer_of() | {"confidence": 0.31, "status": "AMBIGUOUS", "pose": None}
    text = printed([Outcome(OF_PLACE, answer, "", 0.05)], places=("a", "b", "c"))
    assert "AMBIGUOUS 0.310" in text
    assert "0 of 1 answers accepted" in text


def test_the_next_command_is_one_line_with_a_pair_that_was_right() -> None:
    stream = io.StringIO()
    wrong = replace(IN_STREET, rgb=Path("wrong.jpg"))
    outcomes = [outcome_of(wrong, street=None), outcome_of()]
    console = Console(file=stream, width=30)
    print_next(outcomes, Path("map"), Path("samples"), "http://127.0.0.1:81", console, goes_on=True)
    wanted = "localize --url http://127.0.0.1:81 --rgb a.jpg --depth a.png --camera front.json\n"
    assert wanted in stream.getvalue()


def test_the_command_that_serves_the_map_again_shows_the_samples_too() -> None:
    console = Console(file=(stream := io.StringIO()), width=30)
    print_next([outcome_of()], Path("my map"), Path("samples"), "http://127.0.0.1:81", console, goes_on=False)
    assert "serve 'my map' --samples samples\n" in stream.getvalue()
