"""Confidence features outside the range of the calibration data. There the confidence is an extrapolation."""

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from service.maps.calibration import CLIP, Calibration, terms


def extrapolated(
    calibration: Calibration, evidence: Float64[NDArray[np.float64], " F"] | None
) -> tuple[tuple[str, float], ...]:
    """Return the features that the confidence uses and that lie outside the range of the calibration data.

    The range ends where the confidence stops to follow a feature: ``CLIP`` standard deviations from the mean.

    Args:
        calibration: calibration of the map.
        evidence: confidence features of an answer; None without registration, then the result is empty.

    Returns:
        Name, and signed distance from the mean of the calibration data in standard deviations, the farthest first.
    """
    if evidence is None:
        return ()
    right = calibration.right
    away = (evidence - np.array(right.mean)) / np.array(right.spread)
    used = {k for term, weight in zip(terms(len(away)), right.weights, strict=True) if weight != 0 for k in term}
    outside = [(calibration.features[k], float(away[k])) for k in used if abs(away[k]) > CLIP]
    return tuple(sorted(outside, key=lambda each: (-abs(each[1]), each[0])))
