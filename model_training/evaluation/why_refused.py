"""Explain why a map accepts almost no answer: list the possible causes, the likeliest first.

There are two kinds of causes. A wrong focal length or depth unit can be tested: the query is localized again with another value, and a
value that fits the map much better is reported. For the other causes, the confidence features are compared with those of the
calibration data.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from model_training.datasets.dataset import QueryFrame
from model_training.evaluation.predict import Predictions
from service.confidence.decision import calibration_for
from service.confidence.features import FEATURES
from service.confidence.reasons import FOCAL_FACTORS, GAIN, reasons_of, support_of
from service.errors import NoDepthError
from service.geometry.camera import PinholeCamera
from service.imaging.level import is_suspicious_height, level_query
from service.imaging.view_grid import ViewGrid
from service.localization.localizer import Localizer
from service.maps.calibration import Calibration
from service.retrieval.query import Query

#: A map accepts almost no answer if it accepts less than this share of the queries.
FEW = 0.25
#: What to say if few answers are accepted and there is no cause.
NO_CAUSE = "All confidence features are in the range of the calibration data. The place may be outside the map or a perceptual alias."
#: Factors of depth to try.
DEPTH_FACTORS = (0.001, 0.1, 10.0, 1000.0)
#: Largest number of queries to try for each factor.
TRIED = 6
#: Range of the median depth of street images, metres. Within it no other depth unit is tried, because very small depths fit any ground
#: (decision 0108).
USUAL_DEPTH_M = (1.5, 30.0)


@dataclass(frozen=True, slots=True)
class Cause:
    """A possible cause.

    Attributes:
        what: what is wrong or out of range.
        check: what to do.
    """

    what: str
    check: str


def causes(localizer: Localizer, frames: Sequence[QueryFrame], answers: Predictions) -> list[Cause]:
    """Return the possible causes, the likeliest first; none if enough answers are accepted and the camera's height is plausible.

    Args:
        localizer: the localizer of the map.
        frames: the queries of a set. Some of them are localized again.
        answers: the answers to all of them.
    """
    is_few = bool(answers.localized.mean() < FEW) if len(frames) else False
    if not is_few and not suspects_focal_length(frames):
        return []
    queries = [frame.query(localizer.bundle.grid) for frame in _some_of(frames)]
    found = _tried(localizer, queries)
    if not is_few:
        return found
    calibration = calibration_for(localizer.bundle.calibration, queries)
    return found if calibration is None else [*found, *out_of_range(calibration, answers.evidence)]


def suspects_focal_length(frames: Sequence[QueryFrame]) -> bool:
    """Return whether most cameras seem to be at half or twice the usual height, as with a focal length off by a factor of two.

    Args:
        frames: the queries of a set. Some of them are looked at.
    """
    found = []
    for frame in _some_of(frames):
        query = frame.query(ViewGrid())
        level, origin = level_query(
            query.depth_m, query.camera, down_camera=query.down_camera, given=query.camera_height
        )
        found.append(is_suspicious_height(level.height_m, origin))
    return bool(found) and float(np.mean(found)) > 0.5


def _some_of(frames: Sequence[QueryFrame]) -> list[QueryFrame]:
    if not frames:
        return []
    numbers = np.linspace(0, len(frames) - 1, min(TRIED, len(frames))).round().astype(int)
    return [frames[k] for k in np.unique(numbers)]


def out_of_range(calibration: Calibration, evidence: NDArray[np.float64]) -> list[Cause]:
    """Return a cause for each group of confidence features whose median is outside the calibration data, the likeliest first.

    Args:
        calibration: the calibration of the map.
        evidence: confidence features of the answers; rows of NaN where there are none (n, F).
    """
    known = evidence[np.isfinite(evidence).all(axis=1)]
    if not len(known):
        return [
            Cause("no query had enough depth to be registered", each.remedy) for each in reasons_of(calibration, None)
        ]
    found = []
    for reason in reasons_of(calibration, np.median(known, axis=0)):
        deviations = ", ".join(f"{name} {size:+.1f}" for name, size in reason.evidence)
        what = f"{reason.check} (standard deviations from the mean of the calibration data: {deviations})"
        found.append(Cause(what, reason.remedy))
    return found


def _tried(localizer: Localizer, queries: list[Query]) -> list[Cause]:
    """Return the change of focal length or depth unit that fits most queries much better, if there is one.

    The median gain of support must exceed ``GAIN``, and more than half of the queries must gain. A wrong focal length and a wrong unit
    have similar effects. So only the change with the largest gain is reported.
    """
    before = np.array([_support(localizer, query) for query in queries])
    best, gained = None, GAIN
    changes = [("focal", by) for by in FOCAL_FACTORS]
    if not USUAL_DEPTH_M[0] <= _median_depth_m(queries) <= USUAL_DEPTH_M[1]:
        changes += [("depth", by) for by in DEPTH_FACTORS]
    for kind, factor in changes:
        gains = np.array([_support(localizer, _changed(query, kind, factor)) for query in queries]) - before
        if np.median(gains) > gained and (gains > 0).mean() > 0.5:
            best, gained = (kind, factor), float(np.median(gains))
    if best is None:
        return []
    kind, factor = best
    if kind == "focal":
        check = "check the intrinsics, and whether they belong to images of this size"
        return [Cause(f"the focal length is off by a factor of two: fx and fy times {factor:g} fit the map", check)]
    return [
        Cause(f"the depth unit is off: depth times {factor:g} fits the map", "check depth.scale_m and the baseline")
    ]


def _median_depth_m(queries: list[Query]) -> float:
    measured = [query.depth_m[query.depth_m > 0] for query in queries]
    return float(np.median([np.median(each) for each in measured if len(each)])) if any(map(len, measured)) else 0.0


def _support(localizer: Localizer, query: Query) -> float:
    """Return the support of the best pose, nats; 0 without registration."""
    try:
        evidence = localizer.localize(query).evidence
    except NoDepthError:
        return 0.0
    if evidence is None:
        return 0.0
    return support_of(float(evidence[FEATURES.index("inliers")]), float(evidence[FEATURES.index("similarity")]))


def _changed(query: Query, kind: str, factor: float) -> Query:
    """Return the query with its focal length or its depth multiplied by ``factor``."""
    if kind == "depth":
        return replace(query, depth_m=(query.depth_m * np.float32(factor)).astype(np.float32))
    c = query.camera
    return replace(query, camera=PinholeCamera(c.width, c.height, c.fx * factor, c.fy * factor, c.cx, c.cy))
