import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.confidence.decision import decision_of, outcome_of
from service.confidence.features import FEATURES
from service.confidence.fitted_range import MARGIN, extrapolated
from service.confidence.spread import Extent
from service.geometry.camera import PinholeCamera
from service.maps.calibration import Calibration
from service.retrieval.query import Query

#: Ends of the calibration data in every term, standard deviations from the mean.
END = 4.0


@pytest.fixture(scope="module")
def calibration_with(calibration_of):
    """Return a calibration with means 2, standard deviations 0.5, and a rising term for some features."""

    def made(*names: str, bias: float = 0.0) -> Calibration:
        knots = [2.0 - 0.5 * END, 2.0, 2.0 + 0.5 * END]
        terms = [{"feature": name, "knots": knots, "log_odds": [-1.0, 0.0, 3.0]} for name in names]
        found: Calibration = calibration_of(
            features=[{"name": name, "mean": 2.0, "std": 0.5} for name in FEATURES],
            right={"terms": terms, "bias": bias},
        )
        return found

    return made


def evidence_of(**deviations):
    """Return features at the given numbers of standard deviations from the means."""
    row = np.full(len(FEATURES), 2.0)
    for name, size in deviations.items():
        row[FEATURES.index(name)] += 0.5 * size
    return row


def test_features_beyond_the_range_are_named_the_farthest_first(calibration_with):
    calibration = calibration_with("far", "points", "edges")
    found = extrapolated(calibration, evidence_of(far=5.0, points=-7.0, edges=END))
    assert found == (("points", -7.0), ("far", 5.0))


@pytest.mark.parametrize(
    ("name", "below", "above"),
    [
        ("place_m", False, True),
        ("static_inliers", True, False),
        ("occlusion_edges", True, False),
        ("upper_occlusion_edges", True, False),
        ("verified", True, False),
        ("points", True, True),
    ],
)
def test_a_feature_with_an_ideal_has_no_end_there(calibration_with, name, below, above):
    """No place is too near, and no share of inliers or of shared edges is too large. A number of points has no ideal."""
    calibration = calibration_with(name)
    assert bool(extrapolated(calibration, evidence_of(**{name: -6.0}))) is below
    assert bool(extrapolated(calibration, evidence_of(**{name: 6.0}))) is above


def test_a_feature_without_a_term_does_not_count(calibration_with):
    assert extrapolated(calibration_with("far"), evidence_of(points=5.0)) == ()


def test_without_registration_nothing_is_extrapolated(calibration_with):
    assert extrapolated(calibration_with("far"), None) == ()


@given(st.floats(END * (1 + 2 * MARGIN) + 1e-6, 1e6), st.sampled_from([-1.0, 1.0]))
def test_beyond_the_range_the_confidence_no_longer_follows_the_feature(calibration_with, size, sign):
    calibration = calibration_with("far", "points")
    inside, outside = (calibration.log_odds("right", evidence_of(far=sign * at, points=1.0)) for at in (END, size))
    assert outside == pytest.approx(inside)
    assert extrapolated(calibration, evidence_of(far=sign * size, points=1.0)) != ()


@pytest.mark.parametrize(("size", "outside"), [(4.79, False), (4.81, True), (-4.79, False), (-4.81, True)])
def test_the_range_is_a_tenth_wider_than_the_knots(calibration_with, size, outside):
    """The knots are 8 standard deviations apart, so the range ends 0.8 beyond them."""
    assert bool(extrapolated(calibration_with("far"), evidence_of(far=size))) is outside


@pytest.mark.parametrize(
    ("bias", "rate", "status"),
    [(5.0, 0.01, "AMBIGUOUS"), (5.0, 0.001, "AMBIGUOUS"), (5.0, 0.02, "LOCALIZED"), (-5.0, 0.02, "AMBIGUOUS")],
)
def test_an_extrapolated_answer_is_localized_only_at_a_higher_rate_than_the_default(
    calibration_with, bias, rate, status
):
    image = np.ones((4, 4), np.float32)
    camera = PinholeCamera(4, 4, 4.0, 4.0, 1.5, 1.5)
    query = Query(rgb=np.zeros((4, 4, 3), np.uint8), depth_m=image, camera=camera, false_accept_rate=rate)
    calibration = calibration_with("far", bias=bias)
    evidence = evidence_of(far=5.0)
    decision = decision_of(calibration, query, None, evidence)
    found = outcome_of(calibration, query, None, evidence, decision, frames=1, extent=Extent(np.zeros(3), np.eye(3)))
    assert found.extrapolated == (("far", 5.0),)
    assert found.threshold == calibration.threshold_at(rate)
    assert found.status == status
