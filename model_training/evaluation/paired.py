"""Compare two runs over the same queries: differences with intervals for paired data."""

from dataclasses import dataclass
from math import comb, sqrt

import numpy as np
from numpy.typing import NDArray
from scipy.stats import wilcoxon

from model_training.evaluation.error_measures import wilson_interval

#: Number of bootstrap resamples, and their seed.
_RESAMPLES, _SEED = 4000, 20261122
#: Number of resamples that are computed at once.
_BLOCK = 256


@dataclass(frozen=True, slots=True)
class PairedShares:
    """A share of two runs A and B over the same queries.

    Attributes:
        first: share of A.
        second: share of B.
        only_first: number of queries that only A has.
        only_second: number of queries that only B has.
        interval: 95 % interval of the difference, B minus A (Newcombe, Statistics in Medicine 17:2635, 1998, method 10).
        p: two-sided p-value of McNemar's exact test.
        count: number of queries.
    """

    first: float
    second: float
    only_first: int
    only_second: int
    interval: tuple[float, float]
    p: float
    count: int

    @property
    def difference(self) -> float:
        """Difference of the shares, B minus A."""
        return self.second - self.first


def paired_shares(first: NDArray[np.bool_], second: NDArray[np.bool_]) -> PairedShares:
    """Compare a share of two runs over the same queries.

    Args:
        first: whether run A has each query, for example answers it right (n,).
        second: the same for run B (n,).
    """
    count = len(first)
    both, only_first = int((first & second).sum()), int((first & ~second).sum())
    only_second, neither = int((~first & second).sum()), int((~first & ~second).sum())
    return PairedShares(
        float(np.mean(first)),
        float(np.mean(second)),
        only_first,
        only_second,
        _newcombe(both, only_second, only_first, neither),
        mcnemar(only_first, only_second),
        count,
    )


def _newcombe(both: int, only_one: int, only_other: int, neither: int) -> tuple[float, float]:
    """Return the 95 % interval of the difference of two paired proportions, one minus the other (Newcombe 1998, method 10)."""
    n = both + only_one + only_other + neither
    one, other = (both + only_one) / n, (both + only_other) / n
    (low1, high1), (low2, high2) = wilson_interval(both + only_one, n), wilson_interval(both + only_other, n)
    margins = (both + only_one) * (only_other + neither) * (both + only_other) * (only_one + neither)
    excess = both * neither - only_one * only_other
    phi = 0.0 if margins == 0 else (max(excess - n / 2, 0.0) if excess > 0 else excess) / sqrt(margins)
    down, up = _spread(one - low1, high2 - other, phi), _spread(high1 - one, other - low2, phi)
    return max(-1.0, one - other - down), min(1.0, one - other + up)


def _spread(a: float, b: float, phi: float) -> float:
    return sqrt(max(0.0, a * a - 2 * phi * a * b + b * b))


def mcnemar(only_first: int, only_second: int) -> float:
    """Compute the two-sided p-value of McNemar's exact test; 1 without discordant queries.

    Args:
        only_first: number of queries that only the first run has.
        only_second: number of queries that only the second run has.
    """
    parted = only_first + only_second
    fewer = min(only_first, only_second)
    return float(min(1.0, 2 * sum(comb(parted, k) for k in range(fewer + 1)) / 2**parted))


@dataclass(frozen=True, slots=True)
class PairedErrors:
    """Errors of two runs A and B over the queries that both answered.

    Attributes:
        first_median_m: median error of A, metres.
        second_median_m: median error of B, metres.
        mean_difference_m: mean difference, B minus A, metres.
        mean_interval_m: its 95 % bootstrap interval, metres.
        median_difference_m: median difference, B minus A, metres.
        median_interval_m: its 95 % bootstrap interval, metres.
        p: two-sided p-value of Wilcoxon's signed-rank test of no difference; 1 if no query differs.
        count: number of queries that both answered.
    """

    first_median_m: float
    second_median_m: float
    mean_difference_m: float
    mean_interval_m: tuple[float, float]
    median_difference_m: float
    median_interval_m: tuple[float, float]
    p: float
    count: int


def paired_errors(first_m: NDArray[np.float64], second_m: NDArray[np.float64]) -> PairedErrors | None:
    """Compare the errors of two runs over the queries that both answered; None if there are none.

    The intervals are percentiles of the mean and median difference over resampled queries (bootstrap). The seed is fixed.

    Args:
        first_m: errors of run A, metres; infinite without an answer (n,).
        second_m: errors of run B for the same queries (n,).
    """
    both = np.isfinite(first_m) & np.isfinite(second_m)
    if not both.any():
        return None
    difference = second_m[both] - first_m[both]
    rng, means, medians = np.random.default_rng(_SEED), [], []
    for start in range(0, _RESAMPLES, _BLOCK):
        rows = rng.integers(0, len(difference), (min(_BLOCK, _RESAMPLES - start), len(difference)))
        means.append(difference[rows].mean(axis=1))
        medians.append(np.median(difference[rows], axis=1))
    return PairedErrors(
        float(np.median(first_m[both])),
        float(np.median(second_m[both])),
        float(difference.mean()),
        _percentiles(np.concatenate(means)),
        float(np.median(difference)),
        _percentiles(np.concatenate(medians)),
        _signed_rank(difference),
        int(both.sum()),
    )


def _signed_rank(difference: NDArray[np.float64]) -> float:
    if not difference.any():
        return 1.0
    return float(wilcoxon(difference).pvalue)


def _percentiles(values: NDArray[np.float64]) -> tuple[float, float]:
    low, high = np.percentile(values, [2.5, 97.5])
    return float(low), float(high)
