"""Upper bounds of shares from a finite number of trials."""

import numpy as np
from numpy.typing import NDArray
from scipy.stats import beta

#: Certainty of an upper bound, one-sided.
SURE = 0.95


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
