import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.confidence.decision import outcome_of
from service.confidence.extrapolation import extrapolated
from service.confidence.features import FEATURES
from service.confidence.spread import Extent
from service.geometry.camera import PinholeCamera
from service.maps.calibration import CLIP, Calibration, terms
from service.retrieval.query import Query

TERMS = terms(len(FEATURES))


@pytest.fixture(scope="module")
def calibration_with(calibration_of):
    """Means of 2, standard deviations of 0.5, and weights of 1 for some terms."""

    def made(*weighted: tuple[str, ...]) -> Calibration:
        flat = calibration_of().right.model_dump()
        rows = [TERMS.index(tuple(sorted(FEATURES.index(name) for name in names))) for names in weighted]
        weights = np.isin(np.arange(len(TERMS)), rows).astype(float)
        found: Calibration = calibration_of(
            right=flat | {"mean": [2.0] * len(FEATURES), "spread": [0.5] * len(FEATURES), "weights": weights.tolist()}
        )
        return found

    return made


def evidence_of(**deviations):
    """Features that lie so many standard deviations from the means."""
    row = np.full(len(FEATURES), 2.0)
    for name, size in deviations.items():
        row[FEATURES.index(name)] += 0.5 * size
    return row


def test_features_beyond_the_range_are_named_the_farthest_first(calibration_with):
    calibration = calibration_with(("front",), ("points",), ("inliers",))
    found = extrapolated(calibration, evidence_of(front=5.0, points=-7.0, inliers=CLIP))
    assert found == (("points", -7.0), ("front", 5.0))


def test_a_feature_counts_if_any_product_uses_it(calibration_with):
    assert extrapolated(calibration_with(("front", "points")), evidence_of(points=5.0)) == (("points", 5.0),)
    assert extrapolated(calibration_with(("front",)), evidence_of(points=5.0)) == ()


def test_without_registration_nothing_is_extrapolated(calibration_with):
    assert extrapolated(calibration_with(("front",)), None) == ()


@given(st.floats(CLIP + 1e-6, 1e6), st.sampled_from([-1.0, 1.0]))
def test_beyond_the_range_the_confidence_no_longer_follows_the_feature(calibration_with, size, sign):
    calibration = calibration_with(("front",), ("front", "points"))
    inside, outside = (calibration.right.log_odds(evidence_of(front=sign * at, points=1.0)) for at in (CLIP, size))
    assert outside == pytest.approx(inside)
    assert extrapolated(calibration, evidence_of(front=sign * size, points=1.0)) != ()


@pytest.mark.parametrize("bias", [5.0, -5.0])
def test_an_answer_of_any_status_says_it(calibration_with, calibration_of, bias):
    calibration = calibration_with(("front",))
    flat = calibration.right.model_dump() | {"bias": bias}
    image = np.ones((4, 4), np.float32)
    query = Query(rgb=np.zeros((4, 4, 3), np.uint8), depth_m=image, camera=PinholeCamera(4, 4, 4.0, 4.0, 1.5, 1.5))
    found = outcome_of(
        calibration_of(right=flat), query, None, evidence_of(front=5.0), frames=1, extent=Extent(np.zeros(3), np.eye(3)),
    )  # fmt: skip
    assert found.extrapolated == (("front", 5.0),)
    assert (found.status == "LOCALIZED") is (bias > 0)
