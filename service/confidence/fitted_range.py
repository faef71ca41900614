"""The range of the confidence features in the calibration data, and which features of an answer lie outside of it."""

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
    distance between the knots, because a few of the calibration's own queries lie just outside. Some features have an
    ideal value, for example 0 m. On that side the range has no limit: the answer gets no more credit than the best calibration data.
    A recording of the rig may widen the range (``RigCorrection.ranges``).

    Args:
        calibration: calibration for the query, with the correction for its rig.
        evidence: confidence features of an answer; None without registration, then the result is empty.

    Returns:
        Name, and signed distance from the mean of the calibration data in standard deviations, the farthest first.
    """
    if evidence is None:
        return ()
    away = calibration.deviations(evidence)
    of_rig = {} if calibration.rig is None else {each.feature: each for each in calibration.rig.ranges}
    outside = []
    for term in calibration.right.terms:
        column = calibration.names.index(term.feature)
        margin = MARGIN * (term.knots[-1] - term.knots[0])
        least, most = term.knots[0] - margin, term.knots[-1] + margin
        if term.feature in of_rig:
            least, most = min(least, of_rig[term.feature].least), max(most, of_rig[term.feature].most)
        ideal = IDEALS.get(term.feature, 0)
        if (ideal >= 0 and evidence[column] < least) or (ideal <= 0 and evidence[column] > most):
            outside.append((term.feature, float(away[column])))
    return tuple(sorted(outside, key=lambda each: (-abs(each[1]), each[0])))
