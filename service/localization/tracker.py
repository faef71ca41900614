"""Follow a robot over its frames: each frame alone first, then the last frames together, and a belief over all of them."""

from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from service.confidence.decision import Decision, calibration_for
from service.geometry.rigid import Transform, inverse, nearest_rigid
from service.localization.agreement import PREDICTED, agreed, frame_candidate_of, is_likely, updated_belief
from service.localization.answer import Answer, require_finite
from service.localization.belief import Belief, Mode, OdometryStd, agrees, moved, size_of
from service.localization.compose import QueryResult
from service.localization.localizer import Localizer
from service.retrieval.retrieve import EncodedFrame
from service.scoring.candidates import RIVAL_M
from service.timing import stage, timed_request

#: Maximum number of frames that are registered together. Five frames resolve a street of repeating blocks (decision log).
MOST_FRAMES = 5
#: Frames are registered together if they are at least so far apart, metres or radians. Nearer ones show one picture twice.
APART_M, APART_RAD = 0.5, float(np.deg2rad(10.0))
#: An answer is not accepted if its rivals leave it this probability or less.
CONTRADICTED = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """What is known about a robot between two frames.

    Attributes:
        belief: where it may be.
        epoch: number of disruptions so far. A client that compares it with the last answer's knows whether poses before still hold.
        last: pose of the last LOCALIZED answer, moved by the odometry since; None before the first one.
        frames: the last frames, the newest first; their poses are relative to the newest.
    """

    belief: Belief = field(default_factory=Belief)
    epoch: int = 0
    last: Mode | None = None
    frames: tuple[EncodedFrame, ...] = ()

    def broken(self) -> "Track":
        """Return the track after a frame whose odometry is unknown: nothing is left but the count of disruptions."""
        return Track(epoch=self.epoch + int(self.last is not None))


@timed_request()
def follow(
    localizer: Localizer,
    frame: EncodedFrame,
    track: Track,
    T_previous_camera: Transform | None,
    odometry_std: OdometryStd | None = None,
    *,
    beside: tuple[EncodedFrame, ...] = (),
) -> tuple[Answer, Track]:
    """Answer the next frame of a robot.

    1. The frame is registered without the frames before. The modes of the belief are starts too.
    2. The odometry moves the belief. The frame updates it.
    3. If another mode overtakes the one that the robot was at, the robot was displaced. The frames before no longer count.
    4. The answer comes from the frame alone, from the last frames together, or from the belief: the first that is LOCALIZED and that
       nothing contradicts. If it is at another mode than the last LOCALIZED answer, the epoch rises.

    Args:
        localizer: of the map.
        frame: as from ``Localizer.encode_and_search``.
        track: of the frames before; ``Track()`` begins.
        T_previous_camera: odometry, from this camera's frame to the previous camera's frame, metres. None: unknown; the track begins
            again.
        odometry_std: standard deviations of the odometry. None: they follow from the size of the motion.
        beside: frames of the other cameras of a rig at the same moment, with their poses relative to ``frame``. They are registered
            together with it. Frames before are then not registered again, because a rig sees in many directions already.

    Returns:
        The answer with its ``belief`` and ``epoch``, and the track for the next frame.

    Raises:
        RequestError: the calibration does not support such a low false-accept rate.
        NotFiniteError: a number of the answer is not finite, because of a defect of this program or of the map.
    """
    if T_previous_camera is None:
        track, kept, belief, last = track.broken(), tuple[EncodedFrame, ...](), Belief(), None
    else:
        back = inverse(T_previous_camera)
        kept = tuple(
            replace(each, T_reference_camera=nearest_rigid(back @ each.T_reference_camera)) for each in track.frames
        )
        belief = track.belief.moved(T_previous_camera, std=odometry_std)
        last = None if track.last is None else moved(track.last, T_previous_camera, odometry_std)
    if belief.born and frame.query.prior is not None:  # a prior counts once, in the first frame of a track
        frame = replace(frame, query=replace(frame.query, prior=None))
    newest, kept = (frame, *beside), () if beside else kept
    bundle = localizer.bundle
    is_calibrated = bundle.cloud is not None and bundle.calibration is not None
    if not frame.query.refine or not is_calibrated:  # the frame has no probability
        following = Track(belief.unseen(), track.epoch, last, _window(newest, kept))
        answer = localizer.answer((*newest, *_apart(kept)))
        return replace(answer, belief=following.belief, epoch=track.epoch) if is_calibrated else answer, following
    predicted = tuple(mode.T_map_camera for mode in belief.modes[:PREDICTED])
    alone = localizer.register(newest, predicted)
    with stage("register"):
        calibration = calibration_for(bundle.calibration, (each.query for each in newest))
        belief = updated_belief(calibration, frame, alone, belief)
    if _is_overtaken(last, belief):
        kept = ()
    answer = _answer(localizer, newest, _apart(kept), alone, belief)
    epoch = track.epoch
    if answer.status == "LOCALIZED" and answer.candidates and answer.covariance is not None:
        found = frame_candidate_of(answer.candidates[0], answer.covariance, probability=answer.confidence or 0.0)
        epoch += int(last is not None and not agrees(last, found.T_map_camera))
        belief = belief.raised(found)
        last = Mode(found.T_map_camera, found.covariance, found.probability, 0, found.inliers, found.similarity)
    answer = replace(answer, belief=belief, epoch=epoch)
    require_finite(answer)
    return answer, Track(belief, epoch, last, _window(newest, kept))


def _window(newest: tuple[EncodedFrame, ...], kept: tuple[EncodedFrame, ...]) -> tuple[EncodedFrame, ...]:
    """Return the frames to keep for the next one: none of a rig of several cameras.

    A frame near the last kept one shows the same picture, so it is not kept.
    """
    if len(newest) > 1:
        return ()
    is_new = not kept or _is_apart(kept[0])
    return ((*newest, *kept) if is_new else kept)[: MOST_FRAMES - 1]


def _apart(kept: tuple[EncodedFrame, ...]) -> tuple[EncodedFrame, ...]:
    """Return the kept frames that show another picture than the newest frame."""
    return tuple(each for each in kept if _is_apart(each))


def _is_apart(kept: EncodedFrame) -> bool:
    way_m, angle = size_of(kept.T_reference_camera)
    return way_m / APART_M + angle / APART_RAD >= 1.0


def _is_overtaken(last: Mode | None, belief: Belief) -> bool:
    """Return whether a mode elsewhere is likelier than the pose of the last LOCALIZED answer, and than all places without a mode."""
    if last is None or not belief.modes:
        return False
    first = belief.modes[0]
    return not agrees(last, first.T_map_camera) and first.weight > max(belief.elsewhere, belief.outside)


def _answer(
    localizer: Localizer,
    newest: tuple[EncodedFrame, ...],
    before: tuple[EncodedFrame, ...],
    alone: QueryResult,
    belief: Belief,
) -> Answer:
    """Build the answer from the newest frame, else from all frames together, else from the belief: the first that is accepted."""
    ceiling = partial(_ceiling, alone=alone, belief=belief)
    if _is_localized(alone) and ceiling(alone) > CONTRADICTED:
        return localizer.compose(newest, alone)
    found, used = alone, newest
    if before:
        used = (*newest, *before)
        found = localizer.register(used)
        if _is_localized(found) and ceiling(found) > CONTRADICTED:
            return localizer.compose(used, found)
    calibration = calibration_for(localizer.bundle.calibration, (frame.query for frame in used))
    accepted = None if calibration is None else agreed(calibration, belief, newest[0].query.false_accept_rate)
    if calibration is not None and accepted is not None and alone.refined is not None:
        first, best = belief.modes[0], None if found.refined is None else found.refined.best
        if best is not None and agrees(first, best.T_map_camera) and is_likely(calibration, newest[0], found):
            # The pose of all frames is more accurate than that of the newest one.
            return localizer.compose(used, replace(found, decision=accepted))
        refined = alone.refined.with_best(first.T_map_camera)
        return localizer.compose(newest, replace(alone, refined=refined, decision=accepted))
    if found.decision is not None and found.decision.status == "LOCALIZED":
        doubted = Decision("AMBIGUOUS", min(found.decision.confidence, ceiling(found)), found.decision.known)
        found = replace(found, decision=doubted)
    return localizer.compose(used, found)


def _is_localized(found: QueryResult) -> bool:
    return found.decision is not None and found.decision.status == "LOCALIZED"


def _ceiling(found: QueryResult, alone: QueryResult, belief: Belief) -> float:
    """Return an upper limit of the probability of an answer: what its rivals in the belief and in the newest frame leave.

    Frames from before a displacement may outvote the newest frame.
    """
    if found.refined is None or alone.refined is None or alone.decision is None:
        return 0.0
    T = found.refined.best.T_map_camera
    here = sum(mode.weight for mode in belief.modes if agrees(mode, T))
    rival = max((mode.weight for mode in belief.modes if not agrees(mode, T)), default=0.0)
    left = here / (here + rival) if rival > 0 else 1.0
    best = alone.refined.best.T_map_camera
    is_same = float(np.linalg.norm(best[:3, 3] - T[:3, 3])) <= RIVAL_M
    return left if is_same else min(left, 1.0 - alone.decision.confidence)
