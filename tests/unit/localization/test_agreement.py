"""Several image pairs in one request: the frames together, confirmed by what each frame says alone."""

from dataclasses import replace

import numpy as np
import pytest

from service.confidence import decision
from service.confidence.decision import Decision, Outcome
from service.geometry.rigid import transform_from
from service.localization.agreement import registered
from service.retrieval.prior import Prior
from tests.unit.localization.test_tracker import THRESHOLD, calibration, found, in_range

#: The frame before the reference is 2 m behind it.
BEHIND = transform_from(np.eye(3), np.array([0.0, 0.0, -2.0]))


@pytest.fixture(scope="module")
def frames(frame):
    return (frame, replace(frame, T_reference_camera=BEHIND))


@pytest.fixture
def ask(frames, monkeypatch):
    """Return a function that asks two frames: (status, confidence, number of frames that were registered alone)."""
    in_range(monkeypatch)

    def run(together, alone, of=frames):
        rest = iter(alone)
        answer = registered(lambda some, _: together if len(some) > 1 else next(rest), calibration(THRESHOLD), of)
        assert answer.decision is not None
        return answer.decision.status, answer.decision.confidence, len(alone) - len(list(rest))

    return run


def test_frames_that_agree_confirm_the_pose_of_all_of_them(ask):
    """The modes have 0.7, then 0.7 x 2 x 0.7 = 0.98 against 0.28 x 0.28 + 0.02 x 0.02: a probability of 0.925.

    A displacement between the frames has a probability of 0.0105.
    """
    status, confidence, asked = ask(found(0.6, (2.0, 0.9)), [found(0.7, (0.0, 0.99)), found(0.7, (2.0, 0.99))])
    stays = 1 - 0.0105
    mode, rest = stays * 0.7 * 1.4, (stays * 0.28 + 0.00525) * 0.28 + (stays * 0.02 + 0.00525) * 0.02
    assert (status, asked) == ("LOCALIZED", 2)
    assert confidence == pytest.approx(mode / (mode + rest))


@pytest.mark.parametrize(
    ("together", "alone"),
    [
        (found(0.6, (50.0, 0.9)), [found(0.7, (0.0, 0.99)), found(0.7, (2.0, 0.99))]),  # at another place
        (found(0.6, (2.0, 0.9)), [found(0.7, (0.0, 0.99)), found(0.7, (70.0, 0.99))]),  # the frames disagree
        (found(0.6, (2.0, 0.9)), [found(0.97, (0.0, 0.99)), found(0.1, (70.0, 0.99))]),  # the reference is elsewhere
        (found(0.6, (2.0, 0.9)), [found(0.3, (0.0, 0.99)), found(0.3, (2.0, 0.99))]),  # they agree, but weakly
    ],
)
def test_frames_that_do_not_agree_confirm_nothing(ask, together, alone):
    assert ask(together, alone) == ("AMBIGUOUS", 0.6, 2)


def test_an_accepted_or_an_unlikely_pose_needs_no_frame_alone(ask):
    assert ask(found(0.95, (2.0, 0.9)), []) == ("LOCALIZED", 0.95, 0)
    assert ask(found(0.5, (2.0, 0.9)), []) == ("AMBIGUOUS", 0.5, 0)


def test_a_look_alike_needs_no_frame_alone(ask, monkeypatch):
    """A pose without the majority of the support, or out of the calibration's range, is never accepted."""
    alike = found(0.8, (2.0, 0.5), (50.0, 0.5))
    evidence = np.array(alike.evidence)
    evidence[decision._SHARE] = np.log(0.5)
    assert ask(replace(alike, evidence=evidence), [])[0] == "AMBIGUOUS"
    in_range(monkeypatch, (("far", 5.0),))
    assert ask(found(0.6, (2.0, 0.9)), [])[0] == "AMBIGUOUS"


def test_rivals_of_the_frames_together_lower_the_confidence(ask):
    """0.925 times a share of 0.98 reaches 0.9, and times a share of 0.9 it does not."""
    alone = [found(0.7, (0.0, 0.99)), found(0.7, (2.0, 0.99))]
    for share, status in ((0.98, "LOCALIZED"), (0.9, "AMBIGUOUS")):
        together = found(0.6, (2.0, 0.9))
        evidence = np.array(together.evidence)
        evidence[decision._SHARE] = np.log(share)
        assert ask(replace(together, evidence=evidence), alone)[0] == status


def test_one_picture_counts_once(ask, frames):
    """Five frames of a robot that stands still agree, and say no more than one of them."""
    still = tuple(replace(frames[0], T_reference_camera=np.eye(4)) for _ in range(5))
    assert ask(found(0.8, (2.0, 0.9)), [found(0.8, (2.0, 0.99))] * 5, still) == ("AMBIGUOUS", 0.8, 5)


def test_only_the_reference_has_options(frames, monkeypatch):
    in_range(monkeypatch)
    reference = replace(
        frames[0].query, false_accept_rate=0.05, rate_is_named=True, prior=Prior(position_m=np.zeros(2))
    )
    other = replace(frames[1].query, refine=False, false_accept_rate=0.01)
    asked = []

    def register(some, _predicted):
        if len(some) > 1:
            return found(0.6, (0.0, 0.9))
        assert not some[0].query.rate_is_named  # the frames together were refused, if a rate is not supported
        asked.append((some[0].query.refine, some[0].query.false_accept_rate, some[0].query.prior))
        np.testing.assert_array_equal(some[0].T_reference_camera, np.eye(4))
        return found(0.7, (0.0, 0.99))

    registered(register, calibration(THRESHOLD), (replace(frames[0], query=reference), replace(frames[1], query=other)))
    assert asked == [(True, 0.05, None)] * 2


def test_a_map_without_calibration_registers_all_frames_once(frames):
    together, asked = found(0.6, (2.0, 0.9)), []

    def register(some, _predicted):
        asked.append(len(some))
        return together

    assert registered(register, None, frames) is together
    assert asked == [2]


def test_the_answer_of_a_localizer_is_the_confirmed_one(localizer, frames, monkeypatch):
    marked = Decision("LOCALIZED", 0.9321, 0.95)

    def replaced(register, _calibration, some):
        return replace(register(some, ()), decision=marked)

    monkeypatch.setattr("service.localization.localizer.registered", replaced)
    monkeypatch.setattr(
        "service.localization.compose.outcome_of",
        lambda *given, **_: Outcome("LOCALIZED", given[4].confidence, (), (), None),
    )
    assert localizer.answer(frames).confidence == 0.9321
