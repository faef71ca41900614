"""Why an answer is not LOCALIZED: evidence outside the range that calibration saw, and what to check, the likeliest cause first."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from service.localization.judge import SupportWeights
from service.maps.calibration import FEATURES, Calibration

#: Evidence so many standard deviations from calibration's mean is out of its range.
FAR = 3.0
#: Focal lengths that are tried: a camera's intrinsics are often those of pictures of half or twice the size.
FOCAL_FACTORS = (0.5, 2.0)
#: A change of the question is named as the remedy if it raises the support of the best pose by so many nats: the median of several
#: queries, or a single query. A picture from outside the map may fit it a little better with any focal length (decision log).
GAIN, GAIN_OF_ONE = 3.0, 6.0
_WEIGHTS = SupportWeights()


@dataclass(frozen=True, slots=True)
class Reason:
    """One thing to check.

    Attributes:
        check: what may be wrong, as ``baseline``.
        evidence: features that are out of range, with their distances from calibration's means in standard deviations, signed.
        remedy: what to do.
    """

    check: str
    evidence: tuple[tuple[str, float], ...]
    remedy: str


#: What evidence out of range speaks of, the likeliest cause first. What confidence does not weigh is no reason either.
GROUPS: tuple[tuple[str, tuple[str, ...], str], ...] = (
    ("intrinsics", ("facings",), "compare fx, fy, cx, cy and the picture's size with the camera's own calibration"),
    ("depth unit", ("scale",), "check depth.scale_m and depth.kind (metres for each stored unit; z or range)"),
    (
        "field of view or depth range", ("measured", "far"),
        "the pictures measure another share of the view grid than those that confidence was fitted on; check the range of the depth",
    ),
    ("baseline", ("log_noise", "points", "log_sigma"), "check the stereo baseline (depth.baseline_m), and how noisy the depth is"),
    (
        "traffic in the map", ("through", "front", "inliers", "unmapped", "likelihood"),
        "build the map with the traffic vote, and look for what has been built or has moved since the survey",
    ),
    (
        "calibration", ("margin", "similarity_margin", "votes", "entropy", "pose_spread", "residual", "edges", "place_m"),
        "the map's confidence was calibrated on queries unlike these: calibrate on queries like them (streetfix calibrate)",
    ),
)  # fmt: skip
_TOO_LITTLE = Reason(
    "depth", (), "too few pixels have a depth to be registered; check depth.scale_m and that depth belongs to the colour picture"
)  # fmt: skip


def reasons_of(calibration: Calibration, evidence: Float64[NDArray[np.float64], " F"] | None) -> tuple[Reason, ...]:
    """What to check; empty where all evidence lies in the range that calibration saw.

    Args:
        calibration: the map's.
        evidence: of the answer; None where the pictures hold too little to register.
    """
    if evidence is None:
        return (_TOO_LITTLE,)
    away = (evidence - np.array(calibration.right.mean)) / np.array(calibration.right.spread)
    found = []
    for check, names, remedy in GROUPS:
        deviations = ((name, float(away[FEATURES.index(name)])) for name in names)
        far = tuple((name, size) for name, size in deviations if abs(size) > FAR)
        if far:
            found.append(Reason(check, far, remedy))
    return tuple(found)


def support_of(inliers: float, similarity: float) -> float:
    """What speaks for a registered pose whatever its rivals, nats: for comparing answers to a question that was changed."""
    return _WEIGHTS.inliers * inliers + _WEIGHTS.similarity * similarity
