"""Confidence features outside the range of the calibration data. There the confidence is an extrapolation."""

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from service.confidence.features import IDEALS
from service.maps.calibration import Calibration

#: Width of the margin beyond the knots of a term, as a share of the distance between the first and the last.
MARGIN = 0.1


def extrapolated(
    calibration: Calibration, evidence: Float64[NDArray[np.float64], " F"] | None
) -> tuple[tuple[str, float], ...]:
    """Return the features that the confidence uses and that lie outside the range of the calibration data.

    The confidence does not follow a feature beyond the first and the last knot of its term. The range is wider by ``MARGIN`` of the
    distance between the knots, because a few of the calibration's own queries lie just outside. A feature with an ideal, such as no
    distance to the nearest place, has no end on that side: the answer gets no more credit there than the best calibration data.

    Args:
        calibration: calibration of the map.
        evidence: confidence features of an answer; None without registration, then the result is empty.

    Returns:
        Name, and signed distance from the mean of the calibration data in standard deviations, the farthest first.
    """
    if evidence is None:
        return ()
    away = calibration.deviations(evidence)
    outside = []
    for term in calibration.right.terms:
        column = calibration.names.index(term.feature)
        margin = MARGIN * (term.knots[-1] - term.knots[0])
        ideal = IDEALS.get(term.feature, 0)
        below = ideal >= 0 and evidence[column] < term.knots[0] - margin
        above = ideal <= 0 and evidence[column] > term.knots[-1] + margin
        if below or above:
            outside.append((term.feature, float(away[column])))
    return tuple(sorted(outside, key=lambda each: (-abs(each[1]), each[0])))
