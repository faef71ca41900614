import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from model_training.calibration.additive import Penalty, fit_additive
from service.confidence.features import FEATURES, TABLE
from service.maps.calibration import probability

COUNT = len(FEATURES)
BY_NAME = {feature.name: feature for feature in TABLE}
WEAK = Penalty(ridge=0.1, smooth=0.1)


def data(odds, *, count=20_000, seed=1):
    """Uniform features from -1 to 1, and an event whose log odds are a function of them."""
    rng = np.random.default_rng(seed)
    evidence = rng.uniform(-1, 1, (count, COUNT))
    columns = {name: evidence[:, k] for k, name in enumerate(FEATURES)}
    return evidence, rng.random(count) < probability(odds(columns)), np.ones(count)


def of(*names):
    return [BY_NAME[name] for name in names]


def terms_of(model):
    return {term.feature: term for term in model.terms}


def test_a_monotone_curve_is_recovered():
    """The margin (sign 1) contributes -2 below 0 and rises to 2 at 1. The share in front (sign -1) falls by 3."""
    evidence, label, weight = data(lambda f: -2 + 4 * np.maximum(f["margin"], 0) - 1.5 * f["front"], count=60_000)
    terms = terms_of(fit_additive(evidence, label, weight, of("margin", "front"), WEAK))
    at = np.array([-0.9, -0.5, 0.5, 0.9])
    margin = np.interp(at, terms["margin"].knots, terms["margin"].log_odds)
    np.testing.assert_allclose(margin - margin[0], [0, 0, 2, 3.6], atol=0.35)
    front = np.interp(at, terms["front"].knots, terms["front"].log_odds)
    np.testing.assert_allclose(front - front[0], -1.5 * (at - at[0]), atol=0.35)


def test_a_feature_that_contradicts_its_sign_has_no_term():
    """More points in front of the map can never raise the confidence, whatever the data say."""
    evidence, label, weight = data(lambda f: 2 * f["front"] + f["margin"])
    assert set(terms_of(fit_additive(evidence, label, weight, of("margin", "front"), WEAK))) == {"margin"}


def test_a_feature_of_unknown_sign_may_rise_and_fall():
    evidence, label, weight = data(lambda f: 2 - 6 * np.abs(f["edges"]))
    log_odds = terms_of(fit_additive(evidence, label, weight, of("edges"), WEAK))["edges"].log_odds
    middle = int(np.argmax(log_odds))
    assert 0 < middle < len(log_odds) - 1


def test_the_mean_probability_is_the_share_of_the_events():
    """The bias is not penalized, so the weighted residuals sum to 0."""
    evidence, label, _ = data(lambda f: f["margin"] - 1)
    weight = np.where(label, 0.5, 2.0)
    model = fit_additive(evidence, label, weight, of("margin"), Penalty(30.0, 30.0))
    (term,) = model.terms
    odds = model.bias + np.interp(evidence[:, FEATURES.index("margin")], term.knots, term.log_odds)
    assert np.average(probability(odds), weights=weight) == pytest.approx(np.average(label, weights=weight), abs=1e-3)


def test_a_constant_feature_has_no_term():
    evidence, label, weight = data(lambda f: f["margin"])
    evidence[:, FEATURES.index("scale")] = 0.3
    assert set(terms_of(fit_additive(evidence, label, weight, of("margin", "scale"), WEAK))) == {"margin"}


def test_a_stronger_penalty_makes_smaller_terms():
    evidence, label, weight = data(lambda f: 3 * f["margin"], count=2000)
    sizes = []
    for ridge in (0.1, 30.0, 3000.0):
        (term,) = fit_additive(evidence, label, weight, of("margin"), Penalty(ridge, 0.0)).terms
        sizes.append(term.log_odds[-1] - term.log_odds[0])
    assert sizes == sorted(sizes, reverse=True)
    assert sizes[2] < 0.3 * sizes[0]


@given(st.integers(0, 10**6))
@settings(max_examples=10, deadline=None)
def test_every_term_has_the_sign_of_its_feature(seed):
    """Events by pure chance."""
    rng = np.random.default_rng(seed)
    evidence, label = rng.normal(size=(300, COUNT)), rng.random(300) < 0.5
    for term in fit_additive(evidence, label, np.ones(300), TABLE, WEAK).terms:
        sign = BY_NAME[term.feature].sign
        assert sign == 0 or (sign * np.diff(term.log_odds) >= 0).all()
