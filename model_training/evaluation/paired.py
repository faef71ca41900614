"""Two runs over the same queries: differences with intervals that know of the pairing."""

from dataclasses import dataclass
from math import comb, sqrt

import numpy as np
from numpy.typing import NDArray
from scipy.stats import wilcoxon

from model_training.evaluation.error_measures import wilson_interval

_RESAMPLES, _SEED = 4000, 20261122
_BLOCK = 256


@dataclass(frozen=True, slots=True)
class PairedShares:
    """A share of B less that of A over the same queries.

    Attributes:
        first: share of A.
        second: share of B.
        only_first: queries that A alone has.
        only_second: queries that B alone has.
        interval: 95 % of the difference (Newcombe, Statistics in Medicine 17:2635, 1998, method 10).
        p: of McNemar's exact test, two-sided: how often chance alone parts so many of the queries so unevenly.
        count: queries.
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
        """Of the shares, B less A."""
        return self.second - self.first


def paired_shares(first: NDArray[np.bool_], second: NDArray[np.bool_]) -> PairedShares:
    """Compare two answers, right or not, to each of the same queries (n)."""
    count = len(first)
    both, only_first = int((first & second).sum()), int((first & ~second).sum())
    only_second, neither = int((~first & second).sum()), int((~first & ~second).sum())
    return PairedShares(
        float(np.mean(first)), float(np.mean(second)), only_first, only_second,
        _newcombe(both, only_second, only_first, neither), mcnemar(only_first, only_second), count,
    )  # fmt: skip


def _newcombe(both: int, only_one: int, only_other: int, neither: int) -> tuple[float, float]:
    """95 % interval of the share of one less that of the other."""
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
    """Two-sided exact p that queries which parted did so by a fair coin; 1 where none parted."""
    parted = only_first + only_second
    fewer = min(only_first, only_second)
    return float(min(1.0, 2 * sum(comb(parted, k) for k in range(fewer + 1)) / 2**parted))


@dataclass(frozen=True, slots=True)
class PairedErrors:
    """Errors of queries that both runs answered, metres: medians, mean difference (B less A) and its bootstrap interval.

    ``p`` is that of Wilcoxon's signed-rank test, two-sided, of no difference; 1 where no query differs.
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
    """Compare distances (n), infinite for no answer, over the queries that both have; None where there are none.

    Intervals are percentiles of the mean and median difference over resampled queries, from a fixed seed.
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
        float(np.median(first_m[both])), float(np.median(second_m[both])),
        float(difference.mean()), _percentiles(np.concatenate(means)),
        float(np.median(difference)), _percentiles(np.concatenate(medians)), _signed_rank(difference), int(both.sum()),
    )  # fmt: skip


def _signed_rank(difference: NDArray[np.float64]) -> float:
    if not difference.any():
        return 1.0
    return float(wilcoxon(difference).pvalue)


def _percentiles(values: NDArray[np.float64]) -> tuple[float, float]:
    low, high = np.percentile(values, [2.5, 97.5])
    return float(low), float(high)
