"""From evidence to what the robot is told: a probability of being right, and whether to act on it."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from service.localization.answer import Status
from service.maps.calibration import FEATURES, Calibration, probability

#: An answer that is not accepted is ambiguous if the place is more probably in the map than not.
KNOWN = 0.5
#: An accepted answer holds more than half of the support of all places that the query may be at: what keeps strangers out lets
#: through one of six blocks that are all alike.
_SHARE, _HALF = FEATURES.index("log_share"), float(np.log(0.5))


@dataclass(frozen=True, slots=True)
class Decision:
    """Status, and the probability that the position is within 1 m."""

    status: Status
    confidence: float


def decide(
    calibration: Calibration, evidence: Float64[NDArray[np.float64], " F"] | None, false_accept_rate: float, *,
    prior_nats: float = 0.0,
) -> Decision:  # fmt: skip
    """Weigh the evidence.

    Calibration took every second query from outside the map. Whoever sends a prior says that the robot is in it, so the odds of that
    change by Bayes' rule; how surely a place of the map is the right one does not.

    Args:
        calibration: the map's.
        evidence: of the answer; None where the pictures hold too little to register, so nothing speaks for any place.
        false_accept_rate: share of the queries taken outside the map, and without a prior, that one can live with being accepted.
        prior_nats: what a prior that agrees with the answer adds to the log odds of being in the map (``Prior.known_nats``).
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
