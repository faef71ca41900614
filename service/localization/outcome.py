"""Decision: the status and confidence of an answer, and for an answer that is not LOCALIZED, reasons and spread."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from service.errors import RequestError
from service.geometry.rigid import heading_of_camera
from service.localization.answer import Status
from service.localization.decide import decide
from service.localization.query import Query
from service.localization.reasons import Reason, reasons_of
from service.localization.refine import Refined
from service.localization.rivals import distinct_candidates, shares_of
from service.localization.scoring import Candidate
from service.localization.spread import Extent, Spread, spread_of
from service.maps.calibration import Calibration


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """How far an answer can be trusted.

    Attributes:
        status: LOCALIZED, AMBIGUOUS or OUT_OF_MAP. Always LOCALIZED if the query asked for no registration or the map has no
            calibration.
        confidence: calibrated probability that the position is within 1 m; None in these two cases.
        reasons: what to check; empty for a LOCALIZED answer.
        candidates: registered poses, the best supported first; None if nothing was registered. If the answer is not LOCALIZED,
            candidates that exclude each other have covariances.
        spread: mean and covariance over all places where the camera may be; None for a LOCALIZED answer.
    """

    status: Status
    confidence: float | None
    reasons: tuple[Reason, ...]
    candidates: tuple[Candidate, ...] | None
    spread: Spread | None


def outcome_of(
    calibration: Calibration | None, query: Query, refined: Refined | None, evidence: Float64[NDArray[np.float64], " F"] | None, *,
    frames: int, extent: Extent,
) -> Outcome:  # fmt: skip
    """Compute status, confidence, reasons and spread of an answer.

    Args:
        calibration: calibration of the map; None if the map has none, or if the query asked for no registration.
        query: the reference; its prior and its false-accept rate count.
        refined: registered candidates; None if nothing was registered, or if the images have too few points.
        evidence: confidence features, in the order of ``service.maps.calibration.FEATURES``; None without ``refined``.
        frames: number of image pairs.
        extent: extent of the map.
    """
    candidates = None if refined is None else refined.candidates
    if calibration is None:
        return Outcome("LOCALIZED", None, (), candidates, None)
    prior_nats = 0.0
    if query.prior is not None and refined is not None:
        T = refined.best.T_map_camera
        prior_nats = query.prior.known_nats(T[:2, 3], heading_of_camera(T))
    decision = decide(calibration, evidence, query.false_accept_rate, prior_nats=prior_nats)
    if decision.status == "LOCALIZED":
        return Outcome(decision.status, decision.confidence, (), candidates, None)
    candidates = None if refined is None else refined.with_covariances()
    spread = _spread_over(candidates or (), frames, decision.confidence, extent)
    reasons = reasons_of(calibration, evidence, query.depth_m)
    return Outcome(decision.status, decision.confidence, reasons, candidates, spread)


def require_promise(calibration: Calibration | None, query: Query) -> None:
    """Refuse a false-accept rate that the calibration data cannot support.

    Args:
        calibration: calibration of the map; None supports every rate.
        query: query with its false-accept rate.

    Raises:
        RequestError: the rate is lower than the calibration supports.
    """
    if calibration is not None and query.false_accept_rate < calibration.least_false_accept_rate:
        raise RequestError(
            f"false_accept_rate: {query.false_accept_rate:g} is less than this map's calibration can promise; "
            f"ask for {calibration.least_false_accept_rate:g} or more",
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
