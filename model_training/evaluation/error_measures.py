"""Errors of predicted positions (paper, eq. 14-18), with intervals.

The paper counts a distance in frames or pixels as it suits; here a distance is metres on the ground (x, y).
"""

import numpy as np
from numpy.typing import NDArray

Errors = NDArray[np.float64]


def distance_errors(predicted_xy: Errors, true_xy: Errors) -> Errors:
    """ED (eq. 14): distance between prediction and truth, metres, (n)."""
    distances: Errors = np.linalg.norm(predicted_xy - true_xy, axis=1)
    return distances


def error_rate(right: NDArray[np.bool_]) -> float:
    """ER (eq. 15) of a classification: the share that is not right. A metric position is never exactly right."""
    return float(1.0 - np.mean(right))


def mean_error_distance(distances: Errors) -> float:
    """MED (eq. 16): the mean of the error distances, metres."""
    return float(np.mean(distances))


def mean_squared_error(distances: Errors) -> float:
    """MSE (eq. 17, 18): the mean of the squared error distances, m2."""
    return float(np.mean(np.square(distances)))


def root_mean_squared_error(distances: Errors) -> float:
    """Root of the MSE, metres; what ``evo_ape`` calls rmse for the translation part in the plane."""
    return float(np.sqrt(mean_squared_error(distances)))


def heading_errors_deg(predicted_rad: Errors, true_rad: Errors) -> Errors:
    """Size of the difference of headings, degrees, 0 to 180."""
    difference = (predicted_rad - true_rad + np.pi) % (2 * np.pi) - np.pi
    return np.abs(np.rad2deg(difference))


def wilson_interval(successes: int, count: int, *, z: float = 1.959964) -> tuple[float, float]:
    """95 % interval of a share (Wilson, 1927); for no trials it is everything, 0 to 1."""
    if count == 0:
        return 0.0, 1.0
    share = successes / count
    middle = (share + z * z / (2 * count)) / (1 + z * z / count)
    half = z / (1 + z * z / count) * np.sqrt(share * (1 - share) / count + z * z / (4 * count * count))
    return float(max(0.0, middle - half)), float(min(1.0, middle + half))
