"""From the confidence features to the status and the confidence of an answer."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from service.localization.answer import Status
from service.maps.calibration import FEATURES, Calibration, probability

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
    """

    status: Status
    confidence: float


def decide(
    calibration: Calibration, evidence: Float64[NDArray[np.float64], " F"] | None, false_accept_rate: float, *,
    prior_nats: float = 0.0,
) -> Decision:  # fmt: skip
    """Compute status and confidence from the confidence features.

    In the calibration data every second query comes from outside the map. A caller who sends a prior claims that the robot is in
    the map. So the odds of being in the map change by Bayes' rule (decision 0135). The probability that the chosen place is the
    right place of the map does not change: confidence is P(known) P(right | known).

    Args:
        calibration: calibration of the map.
        evidence: confidence features of the answer; None if the images have too few points to register.
        false_accept_rate: largest tolerated share of out-of-map queries that become LOCALIZED, 0 to 1. It holds without a prior.
        prior_nats: increase of the log odds of being in the map by a prior that agrees with the answer (``Prior.known_nats``).

    Returns:
        The decision; OUT_OF_MAP with confidence 0 without ``evidence``.
    """
    if evidence is None:
        return Decision("OUT_OF_MAP", 0.0)
    confidence = float(calibration.confidence(evidence))
    known_odds = calibration.known.log_odds(evidence)
    unprompted, known = (float(odds) for odds in probability(np.array([known_odds, known_odds + prior_nats])))
    if prior_nats > 0:
        confidence = confidence / max(unprompted, confidence) * known
    if confidence >= calibration.threshold(false_accept_rate) and evidence[_SHARE] > _HALF:
        return Decision("LOCALIZED", confidence)
    return Decision("AMBIGUOUS" if known >= KNOWN else "OUT_OF_MAP", confidence)
