"""Tracks with scripted registrations: each frame says where it may be, and with which confidence."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from service.confidence import decision
from service.confidence.decision import Decision, Status
from service.confidence.features import FEATURES
from service.geometry.rigid import transform_from
from service.localization import agreement
from service.localization.belief import KIDNAPPED, KIDNAPPED_ON_THE_WAY, NEW_M, Belief
from service.localization.compose import QueryResult
from service.localization.localizer import Localizer
from service.localization.track_bytes import MOST_BYTES, packed, unpacked
from service.localization.tracker import MOST_FRAMES, Track, follow
from service.maps.calibration import AdditiveModel, Calibration, FeatureStatistics, Threshold
from service.registration.register import Registered
from service.retrieval.prior import Prior
from service.retrieval.retrieve import EncodedFrame, Retrieved
from service.scoring.candidates import Candidate, Refined
from service.scoring.confirmation import Confirmation
from service.scoring.ray_evidence import RayEvidence

LEVEL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
SMALL = np.diag([0.01**2] * 6)
#: The camera drives 2 m ahead, along map x: a whole new picture.
AHEAD = transform_from(np.eye(3), np.array([0.0, 0.0, NEW_M]))
THRESHOLD = 0.9


def candidate(x: float, support: float) -> Candidate:
    registered = Registered(LEVEL, np.array([x, 0.0, 1.5]), 1.0, 0.0, 0.6, np.eye(8), 0)
    T = transform_from(LEVEL, np.array([x, 0.0, 1.5]))
    return Candidate(T, registered, {"similarity": 0.8}, support, SMALL)


def found(confidence: float, *places: tuple[float, float], known: float | None = None) -> QueryResult:
    """Return a registration with candidates (x, share of the support)."""
    candidates = tuple(candidate(x, math.log(share)) for x, share in places)
    refined = Refined(
        candidates,
        SMALL,
        SMALL,
        500,
        1.0,
        Confirmation(0.0, 0.2, 1.7, 0.1),
        RayEvidence(0.9, 0.0, 0.3, 0.3),
        3.0,
        (),
        lambda _: SMALL,
    )
    known = max(confidence, 0.98) if known is None else known
    status: Status = "LOCALIZED" if confidence >= THRESHOLD and places[0][1] > 0.5 else "AMBIGUOUS"
    return QueryResult(Retrieved((), (), None), refined, np.zeros(len(FEATURES)), Decision(status, confidence, known))


def calibration(threshold: float) -> Calibration:
    """Return a calibration that has one threshold at every false-accept rate."""
    model = AdditiveModel(terms=(), bias=0.0)
    features = tuple(FeatureStatistics(name=name, mean=0.0, std=1.0) for name in FEATURES)
    one = (Threshold(false_accept_rate=0.01, confidence=threshold),)
    return Calibration(features=features, right=model, known=model, thresholds=one, measured_on={})


def in_range(monkeypatch: pytest.MonkeyPatch, outside: tuple[tuple[str, float], ...] = ()) -> None:
    """Replace the check of the calibration's range by a result."""
    monkeypatch.setattr(decision, "extrapolated", lambda *_: outside)


class Scripted(Localizer):
    """A localizer whose registrations are given: ``alone`` for each frame, and ``together`` for several of them."""

    def __init__(self, template: Any, alone: list[QueryResult], together: QueryResult | None = None) -> None:
        self.template, self.alone, self.together = template, iter(alone), together
        self.bundle: Any = SimpleNamespace(cloud=True, calibration=calibration(THRESHOLD))
        self.predicted: list[int] = []

    def register(self, frames: tuple[EncodedFrame, ...], predicted: tuple[Any, ...] = ()) -> QueryResult:
        if len(frames) > 1:
            assert self.together is not None
            return self.together
        self.predicted.append(len(predicted))
        return next(self.alone)

    def compose(self, frames: tuple[EncodedFrame, ...], what: QueryResult) -> Any:
        assert what.refined is not None
        assert what.decision is not None
        return replace(
            self.template,
            status=what.decision.status,
            confidence=what.decision.confidence,
            T_map_camera_guess=what.refined.best.T_map_camera,
            covariance=what.refined.covariance,
            candidates=what.refined.candidates,
            frames=len(frames),
        )


@pytest.fixture
def drive(localizer, frame, monkeypatch):
    """Return a function that follows a robot over scripted registrations, and returns x, status, epoch and frames of each answer."""
    in_range(monkeypatch)
    template = localizer.answer((frame,))

    def run(alone: list[QueryResult], together: QueryResult | None = None) -> list[tuple[float, str, int, int]]:
        scripted, track = Scripted(template, alone, together), Track()
        answers: list[tuple[float, str, int, int]] = []
        for number in range(len(alone)):
            answer, track = follow(scripted, frame, track, AHEAD if number else None)
            answers.append((float(answer.T_map_camera_guess[0, 3]), answer.status, answer.epoch, answer.frames))
            assert len(track.frames) <= MOST_FRAMES - 1
        return answers

    return run


class OfRig(Scripted):
    """A localizer that registers the cameras of a rig together, and nothing else."""

    def __init__(self, template: Any, moments: list[QueryResult]) -> None:
        super().__init__(template, [])
        self.moments = iter(moments)

    def register(self, frames: tuple[EncodedFrame, ...], predicted: tuple[Any, ...] = ()) -> QueryResult:
        assert len(frames) == 2
        self.predicted.append(len(predicted))
        return next(self.moments)


def test_the_cameras_of_a_rig_are_one_observation_and_no_frame_before_is_registered_again(
    localizer, frame, monkeypatch
):
    """As with one camera: 0.7, then 0.7 x 2 x 0.7 against 0.28 x 0.28 and 0.02 x 0.02."""
    in_range(monkeypatch)
    rig = OfRig(localizer.answer((frame,)), [found(0.7, (2.0 * k, 0.99)) for k in range(2)])
    first, track = follow(rig, frame, Track(), None, beside=(frame,))
    second, following = follow(rig, frame, track, AHEAD, beside=(frame,))
    assert [(each.status, each.frames) for each in (first, second)] == [("AMBIGUOUS", 2), ("LOCALIZED", 2)]
    assert (track.frames, following.frames, rig.predicted) == ((), (), [0, 1])
    assert second.belief is not None
    assert second.belief.modes[0].weight > THRESHOLD


def test_after_a_rig_one_camera_has_no_frames_before(localizer, frame, monkeypatch):
    in_range(monkeypatch)
    template = localizer.answer((frame,))
    _, track = follow(OfRig(template, [found(0.7, (0.0, 0.99))]), frame, Track(), None, beside=(frame,))
    answer, track = follow(Scripted(template, [found(0.5, (2.0, 0.99))]), frame, track, AHEAD)
    assert (answer.frames, len(track.frames)) == (1, 1)


def test_a_sure_frame_needs_no_other(drive):
    sure = [found(0.97, (2.0 * k, 0.99)) for k in range(3)]
    assert drive(sure) == [(0.0, "LOCALIZED", 0, 1), (2.0, "LOCALIZED", 0, 1), (4.0, "LOCALIZED", 0, 1)]


def test_frames_that_are_unsure_alone_become_sure_by_agreement(drive):
    """0.7, then 0.7 x 2 x 0.7 against 0.28 x 0.28 and 0.02 x 0.02: above 0.9."""
    unsure = [found(0.7, (2.0 * k, 0.99)) for k in range(2)]
    answers = drive(unsure, together=found(0.6, (2.0, 0.9)))
    assert [status for _, status, _, _ in answers] == ["AMBIGUOUS", "LOCALIZED"]


def test_the_frames_together_give_the_pose_if_they_agree_with_the_belief(drive):
    """The belief accepts in both cases. The pose of all frames together is more accurate, but only if it has the majority."""
    unsure = [found(0.7, (2.0 * k, 0.99)) for k in range(2)]
    assert drive(unsure, together=found(0.6, (2.3, 0.9)))[-1] == (pytest.approx(2.3), "LOCALIZED", 0, 2)
    assert drive(unsure, together=found(0.4, (2.3, 0.9)))[-1] == (2.0, "LOCALIZED", 0, 1)
    assert drive(unsure, together=found(0.6, (9.0, 0.9)))[-1] == (2.0, "LOCALIZED", 0, 1)


def test_frames_together_decide_what_one_frame_cannot(drive):
    alone = [found(0.3, (2.0 * k, 0.9)) for k in range(2)]
    assert drive(alone, together=found(0.95, (2.0, 0.95)))[-1] == (2.0, "LOCALIZED", 0, 2)


@pytest.mark.parametrize("threshold", [0.9, 0.3, 0.13])
def test_look_alikes_stay_ambiguous_whatever_the_threshold(drive, monkeypatch, threshold):
    monkeypatch.setattr(f"{__name__}.THRESHOLD", threshold)
    alike = [found(0.9, (2.0 * k, 0.5), (50.0 + 2 * k, 0.5)) for k in range(6)]
    answers = drive(alike, together=found(0.9, (0.0, 0.5), (50.0, 0.5)))
    assert {status for _, status, _, _ in answers} == {"AMBIGUOUS"}


def test_a_displaced_robot_is_ambiguous_once_and_then_begins_an_epoch(drive):
    """The frames before still point to the old place, and all frames together would be LOCALIZED there."""
    old = [found(0.97, (2.0 * k, 0.99)) for k in range(3)]
    new = [found(0.97, (100.0 + 2 * k, 0.99)) for k in range(3)]
    answers = drive(old + new, together=found(0.95, (6.0, 0.95)))
    assert [status for _, status, _, _ in answers] == ["LOCALIZED"] * 3 + ["AMBIGUOUS"] + ["LOCALIZED"] * 2
    assert [epoch for _, _, epoch, _ in answers] == [0, 0, 0, 0, 1, 1]
    assert answers[4][0] == 102.0


def test_unknown_odometry_begins_an_epoch_if_a_pose_was_given_before(localizer, frame, monkeypatch):
    in_range(monkeypatch)
    template = localizer.answer((frame,))
    scripted = Scripted(template, [found(0.2, (0.0, 0.9)), found(0.97, (0.0, 0.99)), found(0.97, (0.0, 0.99))])
    track, epochs = Track(), []
    for _ in range(3):
        answer, track = follow(scripted, frame, track, None)
        epochs.append(answer.epoch)
    assert epochs == [0, 0, 1]


def test_the_modes_are_starts_of_the_next_registration(localizer, frame, monkeypatch):
    in_range(monkeypatch)
    scripted = Scripted(localizer.answer((frame,)), [found(0.6, (0.0, 0.7), (50.0, 0.3)), found(0.97, (2.0, 0.99))])
    _, track = follow(scripted, frame, Track(), None)
    follow(scripted, frame, track, AHEAD)
    assert scripted.predicted == [0, 2]


@pytest.mark.parametrize("rate", [0.01, 0.02])
def test_a_frame_out_of_range_says_nothing_at_the_default_rate(localizer, frame, monkeypatch, rate):
    """At a higher rate, the frame counts as any other: here it finds another place, and the first mode loses its weight."""
    template = localizer.answer((frame,))
    asked = replace(frame, query=replace(frame.query, false_accept_rate=rate))
    elsewhere = found(0.8, (50.0, 0.9))
    scripted = Scripted(template, [found(0.97, (0.0, 0.99)), elsewhere], together=elsewhere)
    in_range(monkeypatch)
    _, track = follow(scripted, asked, Track(), None)
    in_range(monkeypatch, (("far", 5.0),))
    answer, _ = follow(scripted, asked, track, AHEAD)
    assert answer.belief is not None
    first = answer.belief.modes[0]
    if rate == 0.01:
        assert (first.weight, first.unseen) == (pytest.approx(0.97 * (1 - KIDNAPPED - KIDNAPPED_ON_THE_WAY)), 1)
    else:
        assert len(answer.belief.modes) == 2
        assert answer.belief.modes[0].weight < 0.9


def test_frames_of_one_position_are_not_registered_together(localizer, frame):
    track, counts = Track(), []
    for number in range(4):
        answer, track = follow(localizer, frame, track, np.eye(4) if number else None)
        counts.append(answer.frames)
    assert (counts, len(track.frames)) == ([1, 1, 1, 1], 1)


def test_a_prior_counts_once(localizer, frame, monkeypatch):
    """The registration of the first frame uses the prior. Those of later frames do not: one frame alone, and several together."""
    in_range(monkeypatch)
    asked = replace(frame, query=replace(frame.query, prior=Prior(position_m=np.zeros(2))))
    scripted = Scripted(
        localizer.answer((frame,)), [found(0.8, (2.0 * k, 0.99)) for k in range(2)], found(0.5, (2.0, 0.9))
    )
    priors = []
    register = scripted.register
    scripted.register = lambda frames, *more: (priors.append(frames[0].query.prior), register(frames, *more))[1]  # type: ignore[method-assign]
    _, track = follow(scripted, asked, Track(), None)
    follow(scripted, asked, track, AHEAD)
    assert priors[0] is asked.query.prior
    assert len(priors) == 3
    assert priors[1:] == [None, None]


def test_a_belief_with_frames_takes_no_prior(localizer, frame, monkeypatch):
    """``updated_belief`` decides again without the prior, whoever calls it."""
    in_range(monkeypatch)
    decided = []
    monkeypatch.setattr(agreement, "decision_of", lambda _, query, *__: decided.append(query.prior))
    asked = replace(frame, query=replace(frame.query, prior=Prior(position_m=np.zeros(2))))
    alone = found(0.8, (0.0, 0.99))
    belief = agreement.updated_belief(calibration(THRESHOLD), asked, alone, Belief())
    assert decided == []
    assert belief.modes[0].weight == pytest.approx(0.8)
    agreement.updated_belief(calibration(THRESHOLD), asked, alone, belief)
    assert decided == [None]


def test_a_frame_without_registration_keeps_the_belief(localizer, frame, monkeypatch):
    in_range(monkeypatch)
    scripted = Scripted(localizer.answer((frame,)), [found(0.97, (0.0, 0.99)), found(0.97, (100.0, 0.99))])
    scripted.answer = lambda *_: scripted.template  # type: ignore[method-assign]
    _, track = follow(scripted, frame, Track(), None)
    unregistered = replace(frame, query=replace(frame.query, refine=False))
    plain, track = follow(scripted, unregistered, track, AHEAD)
    assert plain.belief is track.belief
    assert (track.belief.modes[0].unseen, track.last is None) == (1, False)
    answer, _ = follow(scripted, frame, track, AHEAD)
    assert answer.epoch == 1


def test_a_map_without_calibration_registers_the_last_frames_together(localizer, frame):
    track, counts = Track(), []
    for number in range(MOST_FRAMES + 1):
        answer, track = follow(localizer, frame, track, AHEAD if number else None)
        counts.append(answer.frames)
        assert answer.belief is None
    assert counts == [1, 2, 3, 4, 5, 5]


def test_a_carried_track_continues_as_a_kept_one(localizer, frame, monkeypatch):
    in_range(monkeypatch)
    frames = [found(0.97, (2.0 * k, 0.9), (50.0 + 2 * k, 0.1)) for k in range(2)]
    scripted = Scripted(localizer.answer((frame,)), frames)
    _, track = follow(scripted, frame, Track(epoch=3), AHEAD)
    content = packed(track, map_version="tiny@1")
    carried = unpacked(content, map_version="tiny@1")
    assert len(content) <= MOST_BYTES
    assert (carried.epoch, carried.frames, carried.belief.born) == (3, (), 2)
    assert carried.belief.elsewhere == track.belief.elsewhere
    assert track.last is not None
    assert carried.last is not None
    for one, other in zip((*track.belief.modes, track.last), (*carried.belief.modes, carried.last), strict=True):
        np.testing.assert_allclose(other.T_map_camera, one.T_map_camera, atol=1e-6)
        np.testing.assert_allclose(other.covariance, one.covariance, rtol=1e-6, atol=1e-12)
        assert (other.weight, other.number, other.unseen) == (one.weight, one.number, one.unseen)


def test_a_carried_track_of_another_map_version_begins_an_epoch(localizer, frame, monkeypatch):
    in_range(monkeypatch)
    scripted = Scripted(localizer.answer((frame,)), [found(0.97, (0.0, 0.9))])
    _, track = follow(scripted, frame, Track(), None)
    other = unpacked(packed(track, map_version="tiny@1"), map_version="tiny@2")
    assert (other.epoch, other.belief.modes, other.last) == (1, (), None)
