import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from model_training.calibration import fit as fitting
from model_training.calibration.fit import RATES, Asked, _thresholds, expected_calibration_error, fit, pooled
from service.confidence.features import FEATURES, RIVALRY, UNWEIGHED
from service.errors import DatasetError
from service.maps.calibration import Logistic, probability, read_calibration, terms
from service.option_limits import FALSE_ACCEPT_RATE

COUNT, NOISE = len(FEATURES), FEATURES.index("log_noise")
INLIERS, MARGIN = FEATURES.index("inliers"), FEATURES.index("margin")
MEAN, SPREAD = 5.0, 2.0  # of every feature


def evidence_of(rng, count):
    """Uniform, so that no feature is ever cut off."""
    return MEAN + SPREAD * rng.uniform(-np.sqrt(3), np.sqrt(3), (count, COUNT))


def asked_of(evidence, right, known, kind=None):
    kind = np.where(known, "clear", "other_city") if kind is None else np.array(kind)
    return Asked(evidence, np.array(right, bool), np.array(known, bool), kind)


def drawn(odds_right, odds_known, *, count=80_000, seed=1):
    """Evidence, and what follows from it by chance with log odds that are functions of the features in deviations."""
    rng = np.random.default_rng(seed)
    evidence = evidence_of(rng, count)
    z = (evidence - MEAN) / SPREAD
    right, known = (rng.random(count) < probability(odds(z)) for odds in (odds_right, odds_known))
    return asked_of(evidence, right, known)


@pytest.fixture(scope="module")
def asked():
    """As many known as not, by a feature that is one of place; right by the margin, inliers squared, and inliers times noise."""
    return drawn(
        lambda z: 0.5 + 1.5 * z[:, MARGIN] - 0.8 * z[:, INLIERS] ** 2 + 0.7 * z[:, INLIERS] * z[:, NOISE],
        lambda z: 1.2 * z[:, INLIERS],
    )


@pytest.fixture(scope="module")
def calibration(asked):
    return fit(asked, measured_on={})


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
    return asked_of(evidence, right, known, kind)


def test_known_probabilities_are_recovered(asked, calibration):
    """With weights that make both halves alike, which here they are to a percent."""
    z = (asked.evidence - MEAN) / SPREAD
    true = probability(0.5 + 1.5 * z[:, MARGIN] - 0.8 * z[:, INLIERS] ** 2 + 0.7 * z[:, INLIERS] * z[:, NOISE])
    error = calibration.confidence(asked.evidence) - true
    assert np.abs(error).mean() < 0.02
    assert np.quantile(np.abs(error), 0.99) < 0.08


def test_the_weights_are_those_of_the_features_and_of_their_products(calibration):
    weights = np.array(calibration.right.weights)
    told = {(MARGIN,): 1.5, (INLIERS, INLIERS): -0.8, tuple(sorted((INLIERS, NOISE))): 0.7}
    expected = [told.get(term, 0.0) for term in terms(COUNT)]
    np.testing.assert_allclose(weights, expected, atol=0.12)
    assert calibration.right.bias == pytest.approx(0.5, abs=0.2)


def test_whether_the_place_is_known_does_not_depend_on_rivals(asked, calibration):
    rivalry, unweighed = (
        np.array([any(FEATURES[k] in names for k in term) for term in terms(COUNT)]) for names in (RIVALRY, UNWEIGHED)
    )
    weights = np.array(calibration.known.weights)
    assert (weights[rivalry | unweighed] == 0).all()
    assert weights[INLIERS] == pytest.approx(1.2, abs=0.1)
    np.testing.assert_array_equal(np.array(calibration.right.weights) != 0, ~unweighed)
    rivals_differ = asked.evidence[:9].copy()
    rivals_differ[:, [FEATURES.index(name) for name in RIVALRY]] = 1e3
    known = calibration.known
    np.testing.assert_array_equal(known.log_odds(rivals_differ), known.log_odds(asked.evidence[:9]))


def test_features_are_told_in_their_own_means_and_deviations(asked, calibration):
    for part in (calibration.right, calibration.known):
        np.testing.assert_allclose(part.mean, asked.evidence.mean(axis=0))
        np.testing.assert_allclose(part.spread, asked.evidence.std(axis=0), rtol=1e-6)


def test_queries_in_the_map_and_outside_it_weigh_the_same_whatever_their_numbers(few):
    """Those outside asked three times over change nothing, but for the ridge, which is left out here."""
    used = few.registered()
    outside = Asked(*(getattr(used, name)[~used.known] for name in ("evidence", "right", "known", "kind")))
    one = fit(used, measured_on={}, ridge=1e-9)
    other = fit(pooled([used, outside, outside]), measured_on={}, ridge=1e-9)
    np.testing.assert_allclose(other.confidence(used.evidence), one.confidence(used.evidence), atol=1e-5)
    known = [each.known.log_odds(used.evidence) for each in (one, other)]
    np.testing.assert_allclose(probability(known[1]), probability(known[0]), atol=1e-5)


def test_what_tells_nothing_leaves_the_share_that_is_right():
    """A third of the known are right and none of the others, and both weigh the same: one in six."""
    rng = np.random.default_rng(2)
    evidence, known = evidence_of(rng, 6000), np.arange(6000) % 4 > 0
    asked = asked_of(evidence, known & (np.arange(6000) % 9 < 3), known)
    found = fit(asked, measured_on={}, ridge=1e6).confidence(evidence)
    share = 0.5 * asked.right[known].mean()
    np.testing.assert_allclose(found, share, atol=0.005)
    assert share == pytest.approx(1 / 6, abs=0.005)


def test_a_stronger_ridge_makes_smaller_weights(few):
    sizes = [np.abs(fit(few, measured_on={}, ridge=ridge).right.weights).sum() for ridge in (0.1, 3.0, 1000.0)]
    assert sizes == sorted(sizes, reverse=True)
    assert sizes[2] < 0.5 * sizes[0]


def test_what_a_feature_tells_without_fail_still_gives_finite_weights():
    rng = np.random.default_rng(3)
    evidence = evidence_of(rng, 400)
    sure = evidence[:, MARGIN] > MEAN
    calibration = fit(asked_of(evidence, sure, sure), measured_on={})
    assert np.isfinite(calibration.right.weights).all()
    assert ((calibration.confidence(evidence) > 0.5) == sure).mean() > 0.97


def test_a_feature_that_never_changes_does_no_harm(few):
    evidence = few.evidence.copy()
    evidence[:, FEATURES.index("scale")] = 0.3
    asked = Asked(evidence, few.right, few.known, few.kind)
    found = fit(asked, measured_on={}).confidence(asked.registered().evidence)
    assert np.isfinite(found).all()
    assert expected_calibration_error(found, asked.registered().right) < 0.1


def confidences(calibration, asked):
    found = np.zeros(len(asked))
    has = np.isfinite(asked.evidence).all(axis=1)
    found[has] = [float(calibration.confidence(row[None])[0]) for row in asked.evidence[has]]
    return found


KINDS = ("other_city", "removed_streets")


def share_through(confidence, asked, level):
    """Of the queries outside the map, each kind weighing alike."""
    return np.mean([np.mean(confidence[~asked.known & (asked.kind == kind)] > level) for kind in KINDS])


def test_thresholds_let_no_more_through_than_their_rate_of_all_kinds_outside_the_map_alike(few):
    """Those without evidence count among the queries, and never get through."""
    calibration = fit(few, measured_on={})
    confidence = confidences(calibration, few)
    assert [each.false_accept_rate for each in calibration.thresholds] == list(RATES)
    for threshold in calibration.thresholds:
        assert share_through(confidence, few, threshold.confidence + 1e-12) <= threshold.false_accept_rate


def test_thresholds_are_no_higher_than_all_kinds_together_need(few):
    """Just below its threshold, one query more gets through than the rate allows; the worst kind may exceed it."""
    calibration = fit(few, measured_on={})
    confidence = confidences(calibration, few)
    for threshold in calibration.thresholds:
        assert share_through(confidence, few, threshold.confidence - 1e-9) > threshold.false_accept_rate
    levels = [threshold.confidence for threshold in calibration.thresholds]
    assert levels == sorted(levels, reverse=True)
    assert levels[0] > levels[-1]
    beyond = [
        np.mean(confidence[few.kind == kind] > level) > rate
        for rate, level in zip(RATES, levels, strict=True)
        for kind in KINDS
    ]
    assert any(beyond)


#: Log odds are the first feature itself.
BY_FIRST = Logistic(
    mean=(0.0,) * COUNT, spread=(1.0,) * COUNT, weights=(1.0, *[0.0] * (len(terms(COUNT)) - 1)), bias=0.0,
)  # fmt: skip


def outside(odds, kind):
    """Queries outside the map of such log odds; NaN for no evidence."""
    evidence = np.zeros((len(odds), COUNT))
    evidence[:, 0] = odds
    return asked_of(evidence, np.zeros(len(odds)), np.zeros(len(odds)), kind)


@pytest.mark.parametrize(
    ("rate", "first_refused"),
    [
        (0.06, 3.0),  # not even the one of the eight
        (0.0625, 2.5),
        (0.3, 2.5),  # one of the two would be a quarter more
        (0.3125, 2.0),  # exactly reached is not exceeded
        (0.374, 2.0),
        (0.375, 1.5),
        (0.49, 1.0),
    ],
)
def test_thresholds_by_hand(monkeypatch, rate, first_refused):
    """Two of one kind weigh a quarter each, eight of another a sixteenth; the surest ones come first."""
    monkeypatch.setattr(fitting, "RATES", (rate,))
    odds = [2.5, -1.0, 3.0, 2.0, 1.5, 1.0, 0.5, 0.0, -0.5, np.nan]
    kind = ["two"] * 2 + ["eight"] * 8
    order = np.random.default_rng(4).permutation(10)
    asked = pooled([outside(np.array(odds)[order], np.array(kind)[order]), known_and_surer()])
    (found,) = _thresholds(asked, BY_FIRST)
    assert found.false_accept_rate == rate
    level = float(probability(np.array(first_refused)))
    assert level < found.confidence <= level + 1e-12  # the refused one itself does not reach it


def known_and_surer():
    """Three queries in the map, surer than any outside; they have no say."""
    evidence = np.full((3, COUNT), 3.9)
    return asked_of(evidence, np.ones(3), np.ones(3), ["eight", "two", "clear"])


def test_queries_that_are_equally_sure_are_refused_together(monkeypatch):
    """Half of four may pass, but the second is as sure as the third."""
    monkeypatch.setattr(fitting, "RATES", (0.5,))
    (found,) = _thresholds(outside([2.0, 1.0, 1.0, 0.0], ["a"] * 4), BY_FIRST)
    assert probability(np.array(1.0)) < found.confidence < probability(np.array(2.0))


def test_no_threshold_is_above_one(monkeypatch):
    """However sure the surest is: next to 1 no number is left above it."""
    monkeypatch.setattr(fitting, "probability", lambda odds: np.ones_like(odds))
    assert {each.confidence for each in _thresholds(outside([2.0, 1.0], ["a"] * 2), BY_FIRST)} == {1.0}


@given(st.integers(0, 10**6), st.integers(2, 5))
@settings(max_examples=30, deadline=None)
def test_how_often_a_kind_was_asked_does_not_move_the_thresholds(seed, times):
    """Every query of one kind asked several times over; were all queries alike, the kind would come to count for more."""
    rng = np.random.default_rng(seed)
    one, other = outside(rng.uniform(0, 3, 60), ["one"] * 60), outside(rng.uniform(-3, 2, 200), ["other"] * 200)
    assert _thresholds(pooled([one] * times + [other]), BY_FIRST) == _thresholds(pooled([one, other]), BY_FIRST)


def test_of_a_kind_that_has_both_only_the_queries_outside_the_map_count_for_its_thresholds(few):
    both = Asked(few.evidence, few.right, few.known, np.full(len(few), "mixed"))
    calibration = fit(both, measured_on={})
    outside = confidences(calibration, both)[~both.known]
    for threshold in calibration.thresholds:
        assert np.mean(outside > threshold.confidence + 1e-12) <= threshold.false_accept_rate
        assert np.sum(outside > threshold.confidence - 1e-9) > int(threshold.false_accept_rate * len(outside))


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
    found = asked_of(evidence, [1, 1, 1, 0], [1, 1, 1, 0], ["a", "b", "c", "d"]).registered()
    assert (found.right.tolist(), found.known.tolist(), found.kind.tolist()) == (
        [True, False],
        [True, False],
        ["a", "d"],
    )
    assert len(found) == len(found.evidence) == 2


def test_pooled_queries_keep_their_order_and_their_kinds():
    one, other = (
        asked_of(np.zeros((2, COUNT)), [1, 0], [1, 1], ["a", "b"]),
        asked_of(np.ones((1, COUNT)), [0], [0], ["longer"]),
    )
    found = pooled([one, other])
    assert found.kind.tolist() == ["a", "b", "longer"]
    assert found.evidence[:, 0].tolist() == [0, 0, 1]
    assert (found.right.tolist(), found.known.tolist()) == ([True, False, False], [True, True, False])


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
    [([1, 1, 1, 1], [1, 1, 0, 0]), ([0, 0, 0, 0], [1, 1, 0, 0]), ([1, 0, 1, 0], [1, 1, 1, 1]), ([1, 0, 0, 0], [0, 0, 0, 0])],
)  # fmt: skip
def test_queries_of_one_sort_alone_are_refused(right, known):
    asked = asked_of(evidence_of(np.random.default_rng(0), 4), right, known)
    with pytest.raises(DatasetError, match="needs right and wrong answers, and queries in the map and outside it"):
        fit(asked, measured_on={})


def test_sorts_without_evidence_do_not_count():
    evidence = evidence_of(np.random.default_rng(0), 4)
    evidence[3] = np.nan  # the only query outside
    with pytest.raises(DatasetError, match="queries in the map and outside it"):
        fit(asked_of(evidence, [1, 0, 1, 0], [1, 1, 1, 0]), measured_on={})
