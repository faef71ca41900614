import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from model_training.calibration import fit as fitting
from model_training.calibration.additive import Penalty
from model_training.calibration.fit import (
    RATES,
    CalibrationData,
    confidences,
    expected_calibration_error,
    fit,
    held_out_confidences,
    out_of_map_kind,
    pooled,
    thresholds_of,
    weights_of,
)
from service.confidence.features import FEATURES, RIVALRY, TABLE, UNWEIGHED
from service.errors import DatasetError
from service.maps.calibration import probability, read_calibration
from service.option_limits import FALSE_ACCEPT_RATE, SAFE_CONFIDENCE

COUNT = len(FEATURES)
INLIERS, MARGIN = FEATURES.index("static_inliers"), FEATURES.index("margin")
MEAN, SPREAD = 5.0, 2.0  # of every feature


def evidence_of(rng, count):
    """Uniform, so that no feature is ever cut off."""
    return MEAN + SPREAD * rng.uniform(-np.sqrt(3), np.sqrt(3), (count, COUNT))


def calibration_data_of(evidence, right, known, kind=None, family="any"):
    kind = np.where(known, "clear", "other_city") if kind is None else np.array(kind)
    count = len(evidence)
    return CalibrationData(
        evidence=evidence,
        right=np.array(right, bool),
        known=np.array(known, bool),
        kind=kind,
        family=np.broadcast_to(np.array(family), (count,)),
        error=np.full((count, 6), np.nan),
        covariance=np.full((count, 6, 6), np.nan),
        heading_rad=np.full(count, np.nan),
    )


@pytest.fixture(scope="module")
def data():
    """As many known as not, by the inliers; right by the margin and the inliers."""
    rng = np.random.default_rng(1)
    evidence = evidence_of(rng, 30_000)
    z = (evidence - MEAN) / SPREAD
    right = rng.random(len(z)) < probability(0.5 + 1.5 * z[:, MARGIN] + 0.8 * z[:, INLIERS])
    known = rng.random(len(z)) < probability(1.2 * z[:, INLIERS])
    return calibration_data_of(evidence, right, known)


@pytest.fixture(scope="module")
def calibration(data):
    return fit(data, measured_on={})


@pytest.fixture(scope="module")
def few():
    """2000 queries, right only where the place is known, a tenth of them without evidence; outside, two kinds."""
    rng = np.random.default_rng(5)
    evidence, known = evidence_of(rng, 2000), rng.random(2000) < 0.6
    odds = (evidence[:, MARGIN] + evidence[:, INLIERS] - 2 * MEAN) / SPREAD
    right = known & (rng.random(2000) < probability(3 * odds))
    evidence[rng.random(2000) < 0.1, 3:] = np.nan
    kind = np.where(known, "clear", np.where(rng.random(2000) < 0.3, "other_city", "removed_streets"))
    evidence[kind == "removed_streets", MARGIN] += 1.0  # more like a place in the map than another city is
    return calibration_data_of(evidence, right, known, kind)


def test_true_probabilities_are_recovered(data, calibration):
    """Both halves have nearly the same number of queries, so the weights change little."""
    z = (data.evidence - MEAN) / SPREAD
    true = probability(0.5 + 1.5 * z[:, MARGIN] + 0.8 * z[:, INLIERS])
    error = calibration.confidence(data.evidence) - true
    assert np.abs(error).mean() < 0.02
    assert np.quantile(np.abs(error), 0.99) < 0.08


def test_whether_the_query_is_in_the_map_does_not_depend_on_competing_candidates(data, calibration):
    used = {term.feature for term in calibration.known.terms}
    assert "static_inliers" in used
    assert not used & {*RIVALRY, *UNWEIGHED}
    rivals_differ = data.evidence[:9].copy()
    rivals_differ[:, [FEATURES.index(name) for name in RIVALRY]] = 1e3
    np.testing.assert_array_equal(
        calibration.log_odds("known", rivals_differ), calibration.log_odds("known", data.evidence[:9])
    )


def test_the_confidence_uses_no_unweighted_feature(calibration):
    used = {term.feature for term in calibration.right.terms}
    assert "margin" in used
    assert not used & set(UNWEIGHED)


def test_the_file_states_mean_and_standard_deviation_of_each_feature(data, calibration):
    np.testing.assert_allclose([each.mean for each in calibration.features], data.evidence.mean(axis=0))
    np.testing.assert_allclose([each.std for each in calibration.features], data.evidence.std(axis=0), rtol=1e-6)


def test_weights_by_hand():
    """Two families; the map and its outside weigh the same in each. Four rows in four groups of 1, 3, 2 and 2."""
    known = [1, 0, 0, 0, 1, 1, 0, 0]
    data = calibration_data_of(np.zeros((8, COUNT)), np.zeros(8), known, family=["a"] * 4 + ["b"] * 4)
    np.testing.assert_allclose(weights_of(data), [2, 2 / 3, 2 / 3, 2 / 3, 1, 1, 1, 1])


def test_a_family_without_out_of_map_queries_has_half_a_weight():
    data = calibration_data_of(np.zeros((6, COUNT)), np.zeros(6), [1, 1, 0, 0, 1, 1], family=["a"] * 4 + ["b"] * 2)
    np.testing.assert_allclose(weights_of(data), 1.0)


def test_queries_in_the_map_and_outside_it_weigh_the_same_whatever_their_numbers(few):
    """Three times as many queries outside change little. The knots and the penalty depend on the number of queries."""
    used = few.registered()
    more = pooled([used, used.where(~used.known), used.where(~used.known)])
    np.testing.assert_allclose(weights_of(more)[more.known].sum(), weights_of(more)[~more.known].sum())
    one, other = (fit(each, measured_on={}) for each in (used, more))
    np.testing.assert_allclose(other.confidence(used.evidence), one.confidence(used.evidence), atol=0.1)


def test_what_tells_nothing_leaves_the_share_that_is_right():
    """A third of the known are right and none of the others, and both weigh the same: one in six."""
    rng = np.random.default_rng(2)
    evidence, known = evidence_of(rng, 6000), np.arange(6000) % 4 > 0
    data = calibration_data_of(evidence, known & (np.arange(6000) % 9 < 3), known)
    found = fit(data, measured_on={}, ridge=1e6).confidence(evidence)
    share = 0.5 * data.right[known].mean()
    np.testing.assert_allclose(found, share, atol=0.005)
    assert share == pytest.approx(1 / 6, abs=0.005)


def test_what_a_feature_tells_without_fail_still_gives_finite_weights():
    rng = np.random.default_rng(3)
    evidence = evidence_of(rng, 400)
    sure = evidence[:, MARGIN] > MEAN
    calibration = fit(calibration_data_of(evidence, sure, sure), measured_on={})
    assert all(np.isfinite(term.log_odds).all() for term in calibration.right.terms)
    assert ((calibration.confidence(evidence) > 0.5) == sure).mean() > 0.97


def test_a_feature_that_never_changes_does_no_harm(few):
    evidence = few.evidence.copy()
    evidence[:, FEATURES.index("scale")] = 0.3
    data = calibration_data_of(evidence, few.right, few.known, few.kind)
    found = fit(data, measured_on={}).confidence(data.registered().evidence)
    assert np.isfinite(found).all()
    assert expected_calibration_error(found, data.registered().right) < 0.1


def test_confidence_is_0_without_registration(few, calibration):
    found = confidences(calibration, few)
    has = np.isfinite(few.evidence).all(axis=1)
    assert (found[~has] == 0).all()
    np.testing.assert_allclose(found[has], calibration.confidence(few.evidence[has]))


def test_a_threshold_does_not_see_the_own_fit_of_a_family():
    """Of two families, the second contradicts the first. Each is predicted from the other, so it is confident where it is wrong."""
    rng = np.random.default_rng(8)
    evidence = evidence_of(rng, 4000)
    high, second = evidence[:, MARGIN] > MEAN, np.arange(4000) >= 2000
    right = high ^ second
    data = calibration_data_of(evidence, right, right, family=np.where(second, "two", "one"))
    found = held_out_confidences(data, TABLE, Penalty(1.0, 1.0))
    assert found[second & high].mean() > 0.9
    assert found[second & ~high].mean() < 0.1
    data.evidence[7] = np.nan
    assert held_out_confidences(data, TABLE, Penalty(1.0, 1.0))[7] == 0


def outside(confidence, kind):
    """Out-of-map queries with these confidences."""
    count = len(confidence)
    return calibration_data_of(np.zeros((count, COUNT)), np.zeros(count), np.zeros(count), kind), np.array(
        confidence, float
    )


def test_thresholds_by_hand(monkeypatch):
    """100 queries of one kind. Up to 5 % may be accepted, so 1 is accepted: the bound of 1 of 100 is 4.7 %, of 2 of 100 it is 6.2 %."""
    monkeypatch.setattr(fitting, "RATES", (0.05, 0.07))
    data, confidence = outside(np.arange(100) / 100, ["a"] * 100)
    first, second = thresholds_of(data, confidence)
    assert first.false_accept_rate == 0.05
    assert 0.98 < first.confidence < 0.98 + 1e-12
    assert 0.97 < second.confidence < 0.97 + 1e-12


def test_a_rate_that_the_data_cannot_support_has_no_threshold(monkeypatch):
    """Without a single accept, 100 queries support 3 % and 50 support 6 %."""
    monkeypatch.setattr(fitting, "RATES", (0.01, 0.04, 0.07))
    rates = {}
    for count in (100, 50):
        found = thresholds_of(*outside(np.linspace(0, 0.5, count), ["a"] * count))
        rates[count] = [each.false_accept_rate for each in found]
    assert rates == {100: [0.04, 0.07], 50: [0.07]}


def test_data_that_support_no_rate_are_refused():
    with pytest.raises(DatasetError, match=r"has 10 effective out-of-map queries, which support no .* of 0\.1 or less"):
        thresholds_of(*outside(np.linspace(0, 0.5, 10), ["a"] * 10))


def test_a_kind_with_few_queries_reduces_the_effective_number(monkeypatch):
    """Two kinds of 20 and 2000 queries weigh the same, so their effective number is 4 / (1/20 + 1/2000) = 79."""
    monkeypatch.setattr(fitting, "RATES", (0.03, 0.04))
    kinds = ["few"] * 20 + ["many"] * 2000
    (found,) = thresholds_of(*outside(np.linspace(0, 0.5, 2020), kinds))
    assert found.false_accept_rate == 0.04


@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        ("car_other_city.sgbm", "other_city"),
        ("removed_streets.precise", "removed_streets"),
        ("narrow_wall.stereo", "wall"),
        ("room.precise", "room"),
        ("field.precise", "field"),
    ],
)
def test_a_kind_is_the_same_for_all_rigs(kind, expected):
    assert out_of_map_kind(kind) == expected


def test_queries_with_equal_confidence_are_refused_together(monkeypatch):
    """2 of 100 may be accepted, but the second is as confident as the third."""
    monkeypatch.setattr(fitting, "RATES", (0.063,))
    (found,) = thresholds_of(*outside([0.9, 0.8, 0.8, *[0.1] * 97], ["a"] * 100))
    assert 0.8 < found.confidence < 0.9


def test_the_default_rate_needs_a_safe_confidence_and_a_higher_rate_does_not(monkeypatch):
    """No out-of-map query is more confident than 0.5."""
    monkeypatch.setattr(fitting, "RATES", (FALSE_ACCEPT_RATE / 2, FALSE_ACCEPT_RATE, 2 * FALSE_ACCEPT_RATE))
    found = thresholds_of(*outside(np.linspace(0, 0.5, 5000), ["a"] * 5000))
    assert [each.confidence for each in found[:2]] == [SAFE_CONFIDENCE] * 2
    assert found[2].confidence < 0.5


def test_no_threshold_is_above_one(monkeypatch):
    monkeypatch.setattr(fitting, "RATES", (0.04,))
    (found,) = thresholds_of(*outside([1.0] * 100, ["a"] * 100))
    assert found.confidence == 1.0


def test_queries_in_the_map_do_not_change_the_thresholds(few):
    confidence = np.linspace(0, 1, len(few))
    only_outside = thresholds_of(few.where(~few.known), confidence[~few.known])
    assert thresholds_of(few, confidence) == only_outside


def test_lower_rates_have_higher_thresholds(few):
    levels = [each.confidence for each in fit(few, measured_on={}).thresholds]
    assert len(levels) > 1
    assert levels == sorted(levels, reverse=True)


def test_the_rate_that_holds_where_none_is_named_is_one_that_has_a_threshold_of_its_own():
    assert FALSE_ACCEPT_RATE in RATES


def test_what_was_fitted_can_be_written_and_read(few):
    calibration = fit(few, measured_on={"cities": "a, b"})
    assert read_calibration(calibration.model_dump_json().encode(), path="x") == calibration
    assert calibration.measured_on == {"cities": "a, b", "queries": 2000}
    assert calibration.site is None


def test_only_queries_with_all_their_evidence_are_registered():
    evidence = np.ones((4, COUNT))
    evidence[1, 3], evidence[2] = np.nan, np.inf
    found = calibration_data_of(evidence, [1, 1, 1, 0], [1, 1, 1, 0], ["a", "b", "c", "d"]).registered()
    assert (found.right.tolist(), found.known.tolist(), found.kind.tolist()) == (
        [True, False],
        [True, False],
        ["a", "d"],
    )
    assert len(found) == len(found.evidence) == 2


def test_pooled_queries_keep_their_order_and_their_kinds():
    one, other = (
        calibration_data_of(np.zeros((2, COUNT)), [1, 0], [1, 1], ["a", "b"]),
        calibration_data_of(np.ones((1, COUNT)), [0], [0], ["longer"]),
    )
    found = pooled([one, other])
    assert found.kind.tolist() == ["a", "b", "longer"]
    assert found.evidence[:, 0].tolist() == [0, 0, 1]
    assert (found.right.tolist(), found.known.tolist()) == ([True, False, False], [True, True, False])
    assert found.of_family("rig").family.tolist() == ["rig"] * 3


@pytest.mark.parametrize(
    ("confidence", "right", "bins", "error"),
    [
        ([0.1, 0.2, 0.8, 0.9], [0, 0, 1, 1], 2, 0.15),
        ([0.1, 0.2, 0.8, 0.9], [0, 0, 1, 1], 1, 0.0),
        ([0.9, 0.1, 0.8, 0.2], [1, 0, 1, 0], 2, 0.15),  # in whatever order
        ([0.1, 0.2, 0.8, 0.9], [1, 1, 0, 0], 2, 0.85),
        ([0.1, 0.2, 0.8, 0.9], [0, 0, 1, 1], 15, 0.15),  # more bins than queries: each alone
        ([0.2, 0.4, 0.9], [0, 1, 0], 2, (2 * 0.2 + 0.9) / 3),  # two and one
        ([0.5] * 4, [1, 0, 1, 0], 1, 0.0),
    ],
)
def test_expected_calibration_error_by_hand(confidence, right, bins, error):
    found = expected_calibration_error(np.array(confidence), np.array(right, bool), bins=bins)
    assert found == pytest.approx(error)


@given(st.integers(0, 10**6), st.integers(1, 200), st.integers(1, 20))
@settings(max_examples=50, deadline=None)
def test_the_calibration_error_lies_between_that_of_all_as_one_and_that_of_each_alone(seed, count, bins):
    rng = np.random.default_rng(seed)
    confidence, right = rng.random(count), rng.random(count) < 0.5
    found = expected_calibration_error(confidence, right, bins=bins)
    assert abs(confidence.mean() - right.mean()) - 1e-12 <= found <= np.abs(confidence - right).mean() + 1e-12


@pytest.mark.parametrize(
    ("right", "known"),
    [
        ([1, 1, 1, 1], [1, 1, 0, 0]),
        ([0, 0, 0, 0], [1, 1, 0, 0]),
        ([1, 0, 1, 0], [1, 1, 1, 1]),
        ([1, 0, 0, 0], [0, 0, 0, 0]),
    ],
)
def test_queries_of_one_sort_alone_are_refused(right, known):
    data = calibration_data_of(evidence_of(np.random.default_rng(0), 4), right, known)
    with pytest.raises(DatasetError, match="needs right and wrong answers, and queries in the map and outside it"):
        fit(data, measured_on={})


def test_sorts_without_evidence_do_not_count():
    evidence = evidence_of(np.random.default_rng(0), 4)
    evidence[3] = np.nan  # the only query outside
    with pytest.raises(DatasetError, match="queries in the map and outside it"):
        fit(calibration_data_of(evidence, [1, 0, 1, 0], [1, 1, 1, 0]), measured_on={})
