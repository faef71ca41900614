"""Why a map accepts nearly no answer: what to check, the likeliest cause first.

Two kinds of findings. Some causes can be tried: a query is asked again as if its focal length or its depth unit were another, and what
then fits the map much better is named. For the others the evidence of the answers is compared with what calibration saw.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from model_training.datasets.dataset import QueryFrame
from model_training.evaluation.predict import Predictions
from service.errors import NoDepthError
from service.geometry.camera import PinholeCamera
from service.localization.localizer import Localizer
from service.localization.query import Query
from service.localization.reasons import FOCAL_FACTORS, GAIN, reasons_of, support_of
from service.maps.calibration import FEATURES, Calibration

#: Nearly nothing is answered: a smaller share of the queries than this is accepted.
FEW = 0.1
#: Factors of depth that are tried, and so many queries at most for each factor.
DEPTH_FACTORS = (0.001, 0.1, 10.0, 1000.0)
TRIED = 6
#: Median depth of a picture of a street, metres. Inside it the unit is right, and no other is tried: tiny depth fits any ground.
USUAL_DEPTH_M = (1.5, 30.0)


@dataclass(frozen=True, slots=True)
class Cause:
    """One thing to check: ``what`` is wrong or out of range, ``check`` says what to do."""

    what: str
    check: str

    def __str__(self) -> str:
        return f"{self.what}: {self.check}"


def causes(localizer: Localizer, frames: Sequence[QueryFrame], answers: Predictions) -> list[Cause]:
    """What to check, the likeliest first; empty where enough is accepted.

    Args:
        localizer: of the map that was asked.
        frames: queries of the set; some of them are asked again.
        answers: to all of them.
    """
    if not len(frames) or answers.localized.mean() >= FEW:
        return []
    chosen = [
        frames[k] for k in np.unique(np.linspace(0, len(frames) - 1, min(TRIED, len(frames))).round().astype(int))
    ]
    queries = [frame.query(localizer.bundle.grid) for frame in chosen]
    found = _tried(localizer, queries)
    calibration = localizer.bundle.calibration
    return found if calibration is None else [*found, *out_of_range(calibration, answers.evidence)]


def out_of_range(calibration: Calibration, evidence: NDArray[np.float64]) -> list[Cause]:
    """Groups of evidence whose median lies far from what calibration saw, the likeliest cause first.

    Args:
        calibration: the map's.
        evidence: of the answers (n, F); rows of NaN where there was none.
    """
    known = evidence[np.isfinite(evidence).all(axis=1)]
    if not len(known):
        return [
            Cause("no query had enough depth to be registered", each.remedy) for each in reasons_of(calibration, None)
        ]
    found = []
    for reason in reasons_of(calibration, np.median(known, axis=0)):
        told = ", ".join(f"{name} {size:+.1f}" for name, size in reason.evidence)
        what = f"{reason.check} (standard deviations from what calibration saw: {told})"
        found.append(Cause(what, reason.remedy))
    return found


def _tried(localizer: Localizer, queries: list[Query]) -> list[Cause]:
    """The one change of focal length or depth unit that makes most queries fit much better, if there is one.

    It has to raise the support of the median query by ``GAIN``. A wrong focal length looks a little like a wrong unit, so only the change
    that helps most is named.
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
        check = "check the intrinsics, and whether they are of pictures of this size"
        return [Cause(f"the focal length is off by a factor of two: fx and fy times {factor:g} fit the map", check)]
    return [
        Cause(f"the depth unit is off: depth times {factor:g} fits the map", "check depth.scale_m and the baseline")
    ]


def _median_depth_m(queries: list[Query]) -> float:
    measured = [query.depth_m[query.depth_m > 0] for query in queries]
    return float(np.median([np.median(each) for each in measured if len(each)])) if any(map(len, measured)) else 0.0


def _support(localizer: Localizer, query: Query) -> float:
    """What speaks for the best pose, nats; 0 where nothing could be registered."""
    try:
        evidence = localizer.localize(query).evidence
    except NoDepthError:
        return 0.0
    if evidence is None:
        return 0.0
    return support_of(float(evidence[FEATURES.index("inliers")]), float(evidence[FEATURES.index("similarity")]))


def _changed(query: Query, kind: str, factor: float) -> Query:
    """A query with another focal length or another unit of depth."""
    if kind == "depth":
        return replace(query, depth_m=(query.depth_m * np.float32(factor)).astype(np.float32))
    c = query.camera
    return replace(query, camera=PinholeCamera(c.width, c.height, c.fx * factor, c.fy * factor, c.cx, c.cy))
