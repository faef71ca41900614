"""Agreement of frames: the belief after each frame alone, and whether it confirms the pose of all frames together."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from service.confidence.decision import Decision, calibration_for, decision_of, is_acceptable, is_in_range, share_of
from service.geometry.rigid import Transform, inverse, nearest_rigid
from service.localization.belief import Belief, FrameCandidate, agrees, sighting_of
from service.localization.compose import QueryResult
from service.maps.calibration import Calibration
from service.retrieval.retrieve import EncodedFrame
from service.scoring.candidates import Candidate, distinct_candidates, shares_of
from service.timing import stage

#: Registers frames, from further start poses too (``Localizer.register``).
Register = Callable[[tuple[EncodedFrame, ...], tuple[Transform, ...]], QueryResult]
#: An answer by agreement needs more than this probability, whatever the false-accept rate: more than all rivals together. The belief
#: needs it, and so does the confidence of the frames together.
MAJORITY = 0.5
#: Number of modes whose predicted poses are starts of the registration.
PREDICTED = 4


def registered(register: Register, calibration: Calibration | None, frames: tuple[EncodedFrame, ...]) -> QueryResult:
    """Register all frames of a query together, and accept their pose if the frames agree about it one by one.

    The confidence of the frames together is below the threshold if each frame has weak evidence. Their agreement is independent
    evidence: a wrong pose of one frame is rarely at the place that the odometry predicts from the wrong pose of another (decision 0169).

    Args:
        register: registers frames.
        calibration: of the map; None confirms nothing.
        frames: image pairs, the reference first, with their poses relative to it.

    Returns:
        The result of the frames together. If they confirm it, the status is LOCALIZED, and the confidence is the probability of the belief
        times the share of the pose in the support of all frames together.

    Raises:
        RequestError: the calibration does not support such a low false-accept rate.
    """
    together = register(frames, ())
    of_query = calibration_for(calibration, (frame.query for frame in frames))
    if calibration is None or of_query is None or len(frames) < 2 or not is_likely(of_query, frames[0], together):
        return together
    belief = _belief_of(register, calibration, frames)
    decision = agreed(of_query, belief, frames[0].query.false_accept_rate)
    if decision is None or together.refined is None or together.evidence is None:
        return together
    if not agrees(belief.modes[0], together.refined.best.T_map_camera):
        return together
    # A perceptual alias moves with the robot, so single frames may agree on it. The rivals of all frames together are more complete.
    confidence = decision.confidence * share_of(together.evidence)
    if confidence < of_query.threshold(frames[0].query.false_accept_rate):
        return together
    return replace(together, decision=replace(decision, confidence=confidence))


def is_likely(calibration: Calibration, reference: EncodedFrame, found: QueryResult) -> bool:
    """Return whether a pose is not LOCALIZED, but may become so if the frames agree: it has the majority, and lies in range.

    Args:
        calibration: for the query.
        reference: its false-accept rate counts.
        found: result of several frames together.
    """
    if found.decision is None or found.evidence is None or found.decision.status == "LOCALIZED":
        return False
    acceptable = is_acceptable(calibration, found.evidence, reference.query.false_accept_rate)
    return found.decision.confidence > MAJORITY and acceptable


def agreed(calibration: Calibration, belief: Belief, false_accept_rate: float) -> Decision | None:
    """Return the decision for the heaviest mode of a belief; None if it does not suffice, or the newest frame is not at it.

    Args:
        calibration: for the query, as from ``calibration_for``.
        belief: after the newest frame.
        false_accept_rate: of the query.
    """
    mode = belief.modes[0] if belief.modes else None
    if mode is None or mode.unseen > 0 or not mode.weight > MAJORITY:
        return None
    if mode.weight < calibration.threshold(false_accept_rate):
        return None
    return Decision("LOCALIZED", mode.weight, 1.0 - belief.outside)


def updated_belief(calibration: Calibration | None, frame: EncodedFrame, alone: QueryResult, belief: Belief) -> Belief:
    """Return the belief after a frame. At the default false-accept rate, a frame outside the range of the calibration is no evidence.

    Args:
        calibration: of the map.
        frame: the frame.
        alone: result of this frame alone.
        belief: before the frame, moved to it.
    """
    decision, calibration = alone.decision, calibration_for(calibration, (frame.query,))
    if alone.refined is None or calibration is None or decision is None:
        return belief.unseen()
    if not is_in_range(calibration, alone.evidence, frame.query.false_accept_rate):
        return belief.unseen()
    if belief.born and frame.query.prior is not None:  # a prior counts once, in the first frame of a track
        decision = decision_of(calibration, replace(frame.query, prior=None), alone.refined, alone.evidence)
        if decision is None:
            return belief.unseen()
    candidates = distinct_candidates(alone.refined.with_covariances())
    seen = [frame_candidate_of(each, each.covariance) for each in candidates if each.covariance is not None]
    return belief.seen(sighting_of(seen, shares_of(candidates, 1), decision.confidence, decision.known))


def frame_candidate_of(
    candidate: Candidate, covariance: Float64[NDArray[np.float64], "6 6"], *, probability: float = 0.0
) -> FrameCandidate:
    """Return a candidate as a belief reads it.

    Args:
        candidate: registered pose with its scores.
        covariance: of the pose.
        probability: that the camera is there.
    """
    inliers, similarity = candidate.registered.inliers, candidate.scores["similarity"]
    return FrameCandidate(candidate.T_map_camera, covariance, probability, inliers, similarity)


def _belief_of(register: Register, calibration: Calibration, frames: tuple[EncodedFrame, ...]) -> Belief:
    """Return the belief after all frames, each registered alone: the last one of the request first, the reference last.

    Only the reference has a prior, and only its options count. The prior counts in the answer of all frames together. That answer also
    checked the rate for the rig of the query, so a single frame is not refused.
    """
    reference, belief, before = frames[0].query, Belief(), None
    for frame in reversed(frames):
        if before is not None:
            belief = belief.moved(nearest_rigid(inverse(before) @ frame.T_reference_camera))
        before = frame.T_reference_camera
        rate = reference.false_accept_rate
        query = replace(frame.query, prior=None, refine=True, false_accept_rate=rate, rate_is_named=False)
        single = replace(frame, query=query, T_reference_camera=np.eye(4))
        alone = register((single,), tuple(mode.T_map_camera for mode in belief.modes[:PREDICTED]))
        with stage("register"):
            belief = updated_belief(calibration, single, alone, belief)
    return belief
