"""Reasons why an answer is not LOCALIZED: confidence features outside the range of the calibration data, and what to check."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64
from numpy.typing import NDArray

from service.confidence.features import FEATURES, IDEALS
from service.confidence.fitted_range import extrapolated
from service.imaging.depth_unit_hint import unit_hint
from service.maps.calibration import Calibration
from service.scoring.support import SupportWeights

#: A confidence feature is a reason if it is more than this many standard deviations from the mean of the calibration data. So is each
#: feature outside the range of the calibration data, because it alone prevents LOCALIZED.
FAR = 3.0
#: Factors of the focal length to try. A common error is to send the intrinsics of an image of half or twice the size.
FOCAL_FACTORS = (0.5, 2.0)
#: Smallest gain of the best pose's support, in nats, for which a changed query is named as the remedy: ``GAIN`` for the median of
#: several queries (decision 0108), ``GAIN_OF_ONE`` for a single query (decision 0132). The limit is higher for a single query,
#: because an out-of-map query may fit the map slightly better with any focal length.
GAIN, GAIN_OF_ONE = 3.0, 6.0
_WEIGHTS = SupportWeights()


@dataclass(frozen=True, slots=True)
class Reason:
    """One possible cause and what to check.

    Attributes:
        check: what may be wrong, for example ``baseline``.
        evidence: confidence features that are far from the calibration data, each with its signed distance from their mean, in standard
            deviations.
        remedy: what to do.
    """

    check: str
    evidence: tuple[tuple[str, float], ...]
    remedy: str


#: Possible causes, the likeliest first: name, confidence features that indicate it, remedy. ``similarity``, ``frames`` and ``log_share``
#: indicate none.
GROUPS: tuple[tuple[str, tuple[str, ...], str], ...] = (
    ("intrinsics", ("facings",), "compare fx, fy, cx, cy and the image size with the calibration of the camera"),
    ("depth unit", ("scale",), "check depth.scale_m and depth.kind (metres for each stored unit; z or range)"),
    (
        "field of view or depth range", ("measured", "far"),
        "the depth covers another share of the view grid than the calibration data; check the range of the depth",
    ),
    ("baseline", ("log_noise", "points", "log_sigma"), "check the stereo baseline (depth.baseline_m) and the noise of the depth"),
    (
        "traffic in the map",
        ("through", "front", "upper_front", "mapped_inliers", "inliers", "upper_inliers", "shared_edges", "contrast", "unmapped",
         "likelihood", "static_inliers", "upper_through", "occlusion_edges", "upper_occlusion_edges", "verified"),
        "look for what was built or moved since the survey; a map that was built with --no-traffic-vote may show passing vehicles",
    ),
    (
        "calibration",
        ("margin", "inlier_advantage", "similarity_margin", "votes", "entropy", "pose_spread", "residual", "edges", "place_m",
         "along_residual", "along_edges"),
        "the map was calibrated on other queries; calibrate it on queries like these (streetfix calibrate)",
    ),
)  # fmt: skip
_TOO_LITTLE = Reason(
    "depth", (), "too few pixels have a depth for registration; check depth.scale_m, and that the depth belongs to the colour image"
)  # fmt: skip


def reasons_of(
    calibration: Calibration,
    evidence: Float64[NDArray[np.float64], " F"] | None,
    depth_m: Float32[NDArray[np.float32], "h w"] | None = None,
) -> tuple[Reason, ...]:
    """List what to check, the likeliest cause first; empty if no confidence feature is unusual and the depth is plausible.

    A feature that is better than the calibration data is no reason, for example an unusually large share of inliers.

    Args:
        calibration: calibration of the map.
        evidence: confidence features of the answer; None if the images have too few points to register.
        depth_m: depth image, metres, 0 where nothing was measured. If its unit looks wrong, this is the first reason. None does
            not check the unit.
    """
    hint = None if depth_m is None else unit_hint(depth_m)
    unit = () if hint is None else (Reason("depth unit", (), hint),)
    named = {each.check for each in unit}
    return (*unit, *(each for each in _by_evidence(calibration, evidence) if each.check not in named))


def _by_evidence(calibration: Calibration, evidence: Float64[NDArray[np.float64], " F"] | None) -> tuple[Reason, ...]:
    if evidence is None:
        return (_TOO_LITTLE,)
    away, outside = calibration.deviations(evidence), dict(extrapolated(calibration, evidence))
    found = []
    for check, names, remedy in GROUPS:
        deviations = ((name, float(away[FEATURES.index(name)])) for name in names)
        far = tuple(
            (name, size)
            for name, size in deviations
            if name in outside or (abs(size) > FAR and size * IDEALS.get(name, 0) <= 0)
        )
        if far:
            found.append(Reason(check, far, remedy))
    return tuple(found)


def support_of(inliers: float, similarity: float) -> float:
    """Compute the part of a pose's support that does not depend on other candidates, nats.

    It serves to compare the answers to a query and to a changed copy of this query.

    Args:
        inliers: share of inliers, 0 to 1.
        similarity: descriptor similarity at the pose.
    """
    return _WEIGHTS.inliers * inliers + _WEIGHTS.similarity * similarity
