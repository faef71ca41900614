"""Upper bounds of shares from a finite number of trials, and the thresholds that follow from them."""

import math
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray
from scipy.stats import beta

from service.maps.calibration import Threshold
from service.option_limits import FALSE_ACCEPT_RATE, SAFE_CONFIDENCE

#: Certainty of an upper bound, one-sided.
SURE = 0.95
#: Share of wrong answers among accepted answers that the default aims at, and that a robot's owner usually requires.
WRONG_RATE = 0.01


def upper_bounds(events: NDArray[np.float64], trials: float) -> NDArray[np.float64]:
    """Return the Clopper-Pearson upper bounds of shares, one-sided with certainty ``SURE``; 1 if all trials are events (n,).

    C. Clopper and E. Pearson, The use of confidence or fiducial limits, Biometrika 1934. It assumes independent trials.

    Args:
        events: numbers of events; effective numbers need not be whole (n,).
        trials: number of trials.
    """
    rest = np.maximum(trials - events, 1e-9)
    return np.asarray(np.where(events >= trials, 1.0, beta.ppf(SURE, events + 1.0, rest)))


def upper_bound(events: float, trials: float) -> float:
    """Return the upper bound of one share, as ``upper_bounds`` does; 1 without trials.

    Args:
        events: number of events.
        trials: number of trials.
    """
    return float(upper_bounds(np.array([float(events)]), trials)[0])


def trials_needed(rate: float) -> int:
    """Return the least number of trials that support a rate: without an event, their upper bound is at most this rate.

    ``(1 - rate)^n`` is the probability of no event. It must be at most ``1 - SURE``.

    Args:
        rate: the rate, 0 to 1, both excluded.
    """
    return math.ceil(math.log(1.0 - SURE) / math.log1p(-rate))


def bounded_thresholds(
    confidence: NDArray[np.float64], weight: NDArray[np.float64], rates: Iterable[float]
) -> tuple[Threshold, ...]:
    """Return for each rate the least confidence that at most this share of out-of-map queries reaches, with certainty ``SURE``.

    The threshold lies just above one of the confidences. For independent queries, the share of new out-of-map queries above this one has
    a beta distribution, whatever the distribution of the confidence (Wilks, Annals of Mathematical Statistics 1941). Its quantile is the
    bound of Clopper and Pearson. At the default rate and below it, the threshold is at least ``SAFE_CONFIDENCE``.

    Args:
        confidence: confidence of each out-of-map query (n,).
        weight: weight of each query; the sum is 1 (n,). The number of queries is the effective one (Kish, Survey Sampling, 1965).
        rates: false-accept rates, rising. A rate that the queries cannot support has no threshold.
    """
    effective = 1.0 / float((weight**2).sum())
    order = np.argsort(-confidence, kind="stable")
    ranked, passed = confidence[order], np.cumsum(weight[order])
    bound = upper_bounds(passed * effective, effective)
    found = []
    for rate in rates:
        if upper_bound(0, effective) > rate:
            continue
        first_refused = min(int(np.searchsorted(bound, rate * (1 + 1e-9), side="right")), len(ranked) - 1)
        level = float(min(1.0, np.nextafter(ranked[first_refused], 2.0)))
        if rate <= FALSE_ACCEPT_RATE:
            level = max(level, SAFE_CONFIDENCE)
        found.append(Threshold(false_accept_rate=rate, confidence=level))
    return tuple(found)
