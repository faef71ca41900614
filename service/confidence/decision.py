"""Decision: the status and the calibrated confidence of an answer; reasons and spread if it is not LOCALIZED."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from service.confidence.features import FEATURES
from service.confidence.fitted_range import extrapolated
from service.confidence.reasons import Reason, reasons_of
from service.confidence.spread import Extent, Spread, spread_of
from service.errors import RequestError
from service.geometry.rigid import heading_of_camera
from service.maps.calibration import Calibration, Threshold, probability
from service.option_limits import FALSE_ACCEPT_RATE
from service.retrieval.query import Query
from service.scoring.candidates import Candidate, Refined, distinct_candidates, shares_of

Status = Literal["LOCALIZED", "AMBIGUOUS", "OUT_OF_MAP"]

#: An answer that is not accepted is AMBIGUOUS if the probability that the query is from the map is at least this; else OUT_OF_MAP.
KNOWN = 0.5
#: The best candidate of an accepted answer must hold more than half of the support of all distinct candidates. The threshold on
#: confidence rejects out-of-map queries. It does not reject perceptual aliases, such as six blocks that look the same (decision 0086).
_SHARE, _HALF = FEATURES.index("log_share"), float(np.log(0.5))


@dataclass(frozen=True, slots=True)
class Decision:
    """Status and confidence of an answer.

    Attributes:
        status: LOCALIZED, AMBIGUOUS or OUT_OF_MAP.
        confidence: probability that the position is within 1 m, 0 to 1.
        known: probability that the camera is in the map, 0 to 1; at least ``confidence``.
    """

    status: Status
    confidence: float
    known: float


def calibration_for(calibration: Calibration | None, queries: Iterable[Query]) -> Calibration | None:
    """Return the calibration for a query: with the correction for its rig, if the map has one.

    Args:
        calibration: calibration of the map; None returns None.
        queries: image pairs of the query, the reference first.
    """
    if calibration is None or not calibration.rigs:
        return calibration
    return calibration.for_rigs(query.rig for query in queries)


def decide(
    calibration: Calibration,
    evidence: Float64[NDArray[np.float64], " F"] | None,
    false_accept_rate: float,
    *,
    prior_nats: float = 0.0,
) -> Decision:
    """Compute status and confidence from the confidence features.

    In the calibration data every second query comes from outside the map. A caller who sends a prior claims that the robot is in
    the map. So the odds of being in the map change by Bayes' rule (decision 0135). The probability that the chosen place is the
    right place of the map does not change: confidence is P(known) P(right | known).

    Args:
        calibration: calibration for the query, as from ``calibration_for``.
        evidence: confidence features of the answer; None if the images have too few points to register.
        false_accept_rate: largest tolerated share of out-of-map queries that become LOCALIZED, 0 to 1. It holds without a prior.
        prior_nats: increase of the log odds of being in the map by a prior that agrees with the answer (``Prior.known_nats``).

    Returns:
        The decision; OUT_OF_MAP with confidence 0 without ``evidence``.
    """
    if evidence is None:
        return Decision("OUT_OF_MAP", 0.0, 0.0)
    confidence = float(calibration.confidence(evidence))
    known_odds = calibration.log_odds("known", evidence)
    # A right answer is in the map, so ``known`` is at least the confidence. The correction of a rig may raise the confidence above it, and
    # a prior would then lower the confidence (decision 0187).
    if calibration.rig is not None or prior_nats > 0:
        known_odds = np.maximum(known_odds, np.log(confidence) - np.log1p(-confidence))
    unprompted, known = (float(odds) for odds in probability(np.array([known_odds, known_odds + prior_nats])))
    if prior_nats > 0:
        confidence = min(confidence / unprompted, 1.0) * known
    if confidence >= calibration.threshold(false_accept_rate) and is_acceptable(
        calibration, evidence, false_accept_rate
    ):
        return Decision("LOCALIZED", confidence, known)
    return Decision("AMBIGUOUS" if known >= KNOWN else "OUT_OF_MAP", confidence, known)


def is_acceptable(
    calibration: Calibration, evidence: Float64[NDArray[np.float64], " F"], false_accept_rate: float
) -> bool:
    """Return whether an answer may be LOCALIZED, whatever its confidence.

    The best candidate needs the majority of the support, and the evidence must be in range (``is_in_range``).

    Args:
        calibration: calibration for the query, with the correction for its rig.
        evidence: confidence features of the answer.
        false_accept_rate: largest tolerated share of out-of-map queries that become LOCALIZED, 0 to 1.
    """
    return is_in_range(calibration, evidence, false_accept_rate) and bool(evidence[_SHARE] > _HALF)


def is_in_range(
    calibration: Calibration, evidence: Float64[NDArray[np.float64], " F"] | None, false_accept_rate: float
) -> bool:
    """Return whether the calibration data support the evidence, as far as the false-accept rate requires it.

    At the default false-accept rate and below, the evidence must lie in the range of the calibration data. On a depth camera of 5 m, two
    thirds of the answers outside of it with a confidence above 0.9 were wrong (decision 0149).

    Args:
        calibration: calibration for the query, with the correction for its rig.
        evidence: confidence features of an answer; None without registration.
        false_accept_rate: largest tolerated share of out-of-map queries that become LOCALIZED, 0 to 1.
    """
    return false_accept_rate > FALSE_ACCEPT_RATE or not extrapolated(calibration, evidence)


def share_of(evidence: Float64[NDArray[np.float64], " F"]) -> float:
    """Return the share of the best candidate in the support of all distinct candidates, 0 to 1.

    Args:
        evidence: confidence features of the answer.
    """
    return float(np.exp(evidence[_SHARE]))


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """How far an answer can be trusted.

    Attributes:
        status: LOCALIZED, AMBIGUOUS or OUT_OF_MAP. Always LOCALIZED if the query requested no registration or the map has no
            calibration.
        confidence: calibrated probability that the position is within 1 m; None in these two cases.
        reasons: what to check; empty for a LOCALIZED answer.
        candidates: registered poses, the best supported first; None if nothing was registered. If the answer is not LOCALIZED,
            candidates that exclude each other have covariances.
        spread: mean and covariance over all places where the camera may be; None for a LOCALIZED answer.
        extrapolated: confidence features outside the range of the calibration data, as from ``fitted_range.extrapolated``.
        threshold: the threshold that decided, with its false-accept rate; None if ``confidence`` is None.
        rig_correction: name of the correction for a rig that the confidence has; None without one.
    """

    status: Status
    confidence: float | None
    reasons: tuple[Reason, ...]
    candidates: tuple[Candidate, ...] | None
    spread: Spread | None
    extrapolated: tuple[tuple[str, float], ...] = ()
    threshold: Threshold | None = None
    rig_correction: str | None = None


def decision_of(
    calibration: Calibration | None,
    query: Query,
    refined: Refined | None,
    evidence: Float64[NDArray[np.float64], " F"] | None,
) -> Decision | None:
    """Decide about an answer, with the prior and the false-accept rate of its query.

    Args:
        calibration: calibration for the query; None if the map has none, or if the query requested no registration.
        query: the reference.
        refined: registered candidates; None if nothing was registered, or if the images have too few points.
        evidence: confidence features, in the order of ``service.confidence.features.FEATURES``; None without ``refined``.

    Returns:
        The decision; None without a calibration.
    """
    if calibration is None:
        return None
    prior_nats = 0.0
    if query.prior is not None and refined is not None:
        T = refined.best.T_map_camera
        prior_nats = query.prior.known_nats(T[:2, 3], heading_of_camera(T))
    return decide(calibration, evidence, query.false_accept_rate, prior_nats=prior_nats)


def outcome_of(
    calibration: Calibration | None,
    query: Query,
    refined: Refined | None,
    evidence: Float64[NDArray[np.float64], " F"] | None,
    decision: Decision | None,
    *,
    frames: int,
    extent: Extent,
) -> Outcome:
    """Compute reasons and spread of an answer from its decision.

    Args:
        calibration: calibration for the query; None if the map has none, or if the query requested no registration.
        query: the reference; its false-accept rate counts.
        refined: registered candidates; None if nothing was registered, or if the images have too few points.
        evidence: confidence features, in the order of ``service.confidence.features.FEATURES``; None without ``refined``.
        decision: as from ``decision_of``; a track may replace it by its own.
        frames: number of image pairs.
        extent: extent of the map.
    """
    candidates = None if refined is None else refined.candidates
    if calibration is None or decision is None:
        return Outcome("LOCALIZED", None, (), candidates, None)
    outside, threshold = extrapolated(calibration, evidence), calibration.threshold_at(query.false_accept_rate)
    rig = None if calibration.rig is None else calibration.rig.name
    if decision.status == "LOCALIZED":
        return Outcome(decision.status, decision.confidence, (), candidates, None, outside, threshold, rig)
    candidates = None if refined is None else refined.with_covariances()
    spread = _spread_over(candidates or (), frames, decision.confidence, extent)
    reasons = reasons_of(calibration, evidence, query.depth_m)
    return Outcome(decision.status, decision.confidence, reasons, candidates, spread, outside, threshold, rig)


def require_promise(calibration: Calibration | None, query: Query) -> None:
    """Refuse a false-accept rate that the calibration data cannot support.

    If the recording of the query's rig set thresholds, they decide about a rate that the request names. The default rate belongs to all
    rigs of the service. Such a query is answered, by the stricter of both thresholds (``Calibration.threshold_at``).

    Args:
        calibration: calibration for the query, as from ``calibration_for``; None supports every rate.
        query: query with its false-accept rate.

    Raises:
        RequestError: the rate is lower than the calibration supports.
    """
    if calibration is None:
        return
    least, what = calibration.least_false_accept_rate, "the calibration of this map supports"
    of_rig = calibration.least_rate_of_rig if query.rate_is_named else None
    if of_rig is not None and calibration.rig is not None:
        least, what = (
            of_rig,
            f"the recording of this rig supports ({calibration.rig.name}, {calibration.rig.outside} out-of-map frames)",
        )
    if query.false_accept_rate < least:
        raise RequestError(
            f"options.false_accept_rate: {query.false_accept_rate:g} is below what {what}; send {least:g} or more",
            field="options.false_accept_rate",
        )


def _spread_over(candidates: tuple[Candidate, ...], frames: int, confidence: float, extent: Extent) -> Spread:
    distinct = distinct_candidates(candidates)
    covariances = [each.covariance for each in distinct if each.covariance is not None]
    return spread_of(
        [each.T_map_camera for each in distinct],
        covariances,
        shares_of(distinct, frames),
        confidence=confidence,
        extent=extent,
    )
