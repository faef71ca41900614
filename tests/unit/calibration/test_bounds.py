import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import binom

from model_training.calibration.bounds import SURE, upper_bound


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
