"""From evidence to what the robot is told: a probability of being right, and whether to act on it."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from service.localization.answer import Status
from service.maps.calibration import Calibration, probability

#: An answer that is not accepted is ambiguous if the place is more probably in the map than not.
KNOWN = 0.5
#: Were the place in the map for certain, an accepted answer would be right in one case of three at least: what keeps strangers out lets
#: through one of six blocks that are all alike.
ALIKE = 0.35


@dataclass(frozen=True, slots=True)
class Decision:
    """Status, and the probability that the position is within 1 m."""

    status: Status
    confidence: float


def decide(
    calibration: Calibration, evidence: Float64[NDArray[np.float64], " F"] | None, false_accept_rate: float
) -> Decision:
    """Weigh the evidence.

    Args:
        calibration: the map's.
        evidence: of the answer; None where the pictures hold too little to register, so nothing speaks for any place.
        false_accept_rate: share of the queries taken outside the map that one can live with being accepted.
    """
    if evidence is None:
        return Decision("OUT_OF_MAP", 0.0)
    confidence = float(calibration.confidence(evidence))
    known = float(probability(calibration.known.log_odds(evidence)))
    if confidence >= max(calibration.threshold(false_accept_rate), ALIKE * known):
        return Decision("LOCALIZED", confidence)
    return Decision("AMBIGUOUS" if known >= KNOWN else "OUT_OF_MAP", confidence)
