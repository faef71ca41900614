import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import binom

from model_training.calibration.bounds import SURE, bounded_thresholds, trials_needed, upper_bound


@pytest.mark.parametrize(
    ("accepted", "queries", "bound"),
    [(0, 26, 0.1088), (0, 300, 0.0099), (1, 100, 0.0466), (5, 100, 0.1023), (7, 7, 1.0)],
)
def test_the_upper_bound_by_hand(accepted, queries, bound):
    """0 of n: 1 - 0.05 ** (1 / n). The others from the table of Clopper and Pearson."""
    assert upper_bound(accepted, queries) == pytest.approx(bound, abs=2e-4)


@given(st.integers(1, 400), st.floats(0, 1))
@settings(max_examples=40)
def test_at_the_upper_bound_so_few_events_are_improbable(queries, share):
    accepted = int(share * (queries - 1))
    bound = upper_bound(accepted, queries)
    assert binom.cdf(accepted, queries, bound) == pytest.approx(1 - SURE, abs=1e-6)


@pytest.mark.parametrize(("rate", "trials"), [(0.01, 299), (0.05, 59), (0.002, 1497), (0.5, 5)])
def test_the_number_of_trials_that_a_rate_needs(rate, trials):
    """0.99 ** 299 = 0.0495, and 0.99 ** 298 = 0.05004."""
    assert trials_needed(rate) == trials
    assert upper_bound(0, trials) <= rate < upper_bound(0, trials - 1)


def test_a_rate_that_the_queries_cannot_support_has_no_threshold():
    found = bounded_thresholds(np.linspace(0, 0.5, 50), np.full(50, 1 / 50), (0.05, 0.07))
    assert [each.false_accept_rate for each in found] == [0.07]
    assert found[0].confidence == np.nextafter(0.5, 1)


def test_a_threshold_keeps_its_rate_with_the_stated_certainty():
    """59 queries support 5 %. The largest of them is exceeded by more than 5 % of all queries with a probability of 0.95 ** 59 = 0.0485."""
    rng, weight = np.random.default_rng(7), np.full(59, 1 / 59)
    levels = [bounded_thresholds(rng.random(59), weight, (0.05,))[0].confidence for _ in range(2000)]
    share = float(np.mean(1 - np.array(levels) > 0.05))  # the confidence is uniform
    assert share == pytest.approx(0.0485, abs=0.015)  # three standard deviations
