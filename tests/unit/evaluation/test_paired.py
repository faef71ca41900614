"""Paired differences and their confidence intervals."""

import numpy as np
import pytest
from scipy.stats import binomtest

from model_training.evaluation.paired import mcnemar, paired_errors, paired_shares


def flags(both, only_first, only_second, neither):
    first = [True] * (both + only_first) + [False] * (only_second + neither)
    second = [True] * both + [False] * only_first + [True] * only_second + [False] * neither
    return np.array(first), np.array(second)


def test_counts_shares_and_difference():
    found = paired_shares(*flags(5, 1, 3, 1))
    assert (found.first, found.second, found.only_first, found.only_second, found.count) == (0.6, 0.8, 1, 3, 10)
    assert found.difference == pytest.approx(0.2)


@pytest.mark.parametrize(("first", "second"), [(0, 0), (0, 6), (3, 9), (10, 10), (1, 30)])
def test_mcnemar_is_the_binomial_test(first, second):
    expected = 1.0 if first + second == 0 else binomtest(first, first + second, 0.5).pvalue
    assert mcnemar(first, second) == pytest.approx(expected)


def test_the_interval_turns_round_with_the_runs():
    low, high = paired_shares(*flags(36, 12, 2, 0)).interval
    again_low, again_high = paired_shares(*flags(36, 2, 12, 0)).interval
    assert (low, high) == pytest.approx((-again_high, -again_low))


def test_equal_runs_differ_by_nothing_with_an_interval_around_it():
    found = paired_shares(*flags(20, 0, 0, 20))
    assert found.difference == 0
    assert found.p == 1
    assert found.interval[0] == pytest.approx(-found.interval[1])
    assert 0 < found.interval[1] < 0.1


def test_nineteen_of_twenty_intervals_hold_the_truth():
    rng, held = np.random.default_rng(5), 0
    for _ in range(600):
        first = rng.random(80) < 0.7
        second = np.where(rng.random(80) < 0.8, first, rng.random(80) < 0.9)  # 0.8 * 0.7 + 0.2 * 0.9 = 0.74
        low, high = paired_shares(first, second).interval
        held += low <= 0.04 <= high
    assert 0.93 <= held / 600 <= 0.985


def test_errors_are_compared_where_both_answered():
    found = paired_errors(np.array([1.0, 2.0, np.inf, 4.0]), np.array([1.5, 2.5, 1.0, np.inf]))
    assert found is not None
    assert (found.count, found.mean_difference_m, found.median_difference_m) == (2, 0.5, 0.5)
    assert found.mean_interval_m == (0.5, 0.5)


def test_the_bootstrap_interval_matches_the_standard_error_and_is_repeatable():
    rng = np.random.default_rng(1)
    first, second = rng.random(200), rng.random(200)
    found = paired_errors(first, second)
    assert found == paired_errors(first, second)
    assert found is not None
    width = found.mean_interval_m[1] - found.mean_interval_m[0]
    assert width == pytest.approx(2 * 1.96 * (second - first).std(ddof=1) / np.sqrt(200), rel=0.08)


def test_nothing_answered_is_nothing_compared():
    assert paired_errors(np.array([np.inf]), np.array([1.0])) is None
