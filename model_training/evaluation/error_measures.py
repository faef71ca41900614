"""Error measures of predicted positions (paper, eq. 14-18), with intervals.

The paper measures distances in frames or in pixels. Here a distance is in metres on the ground (x, y).
"""

import numpy as np
from numpy.typing import NDArray

#: An array of positions, angles or errors; the functions give its shape.
Errors = NDArray[np.float64]


def distance_errors(predicted_xy: Errors, true_xy: Errors) -> Errors:
    """Compute the ED (eq. 14): distance between prediction and ground truth, metres (n,).

    Args:
        predicted_xy: predicted positions, metres, map frame (n, 2).
        true_xy: true positions, metres, map frame (n, 2).
    """
    distances: Errors = np.linalg.norm(predicted_xy - true_xy, axis=1)
    return distances


def error_rate(right: NDArray[np.bool_]) -> float:
    """Compute the ER (eq. 15) of a classification: the share of wrong answers.

    It does not apply to metric positions, because these are never exactly right.

    Args:
        right: whether each answer is right (n,).
    """
    return float(1.0 - np.mean(right))


def mean_error_distance(distances: Errors) -> float:
    """Compute the MED (eq. 16): mean of the error distances, metres.

    Args:
        distances: error distances, metres (n,).
    """
    return float(np.mean(distances))


def mean_squared_error(distances: Errors) -> float:
    """Compute the MSE (eq. 17, 18): mean of the squared error distances, square metres.

    Args:
        distances: error distances, metres (n,).
    """
    return float(np.mean(np.square(distances)))


def root_mean_squared_error(distances: Errors) -> float:
    """Compute the root of the MSE, metres. ``evo_ape`` calls it rmse, for the translation part in the plane.

    Args:
        distances: error distances, metres (n,).
    """
    return float(np.sqrt(mean_squared_error(distances)))


def heading_errors_deg(predicted_rad: Errors, true_rad: Errors) -> Errors:
    """Compute the absolute difference of headings, degrees, 0 to 180 (n,).

    Args:
        predicted_rad: predicted headings, radians (n,).
        true_rad: true headings, radians (n,).
    """
    difference = (predicted_rad - true_rad + np.pi) % (2 * np.pi) - np.pi
    return np.abs(np.rad2deg(difference))


def wilson_interval(successes: int, count: int, *, z: float = 1.959964) -> tuple[float, float]:
    """Compute the 95 % interval of a share (Wilson, 1927); 0 to 1 without trials.

    Args:
        successes: number of successes.
        count: number of trials.
        z: quantile of the standard normal distribution that belongs to the level of the interval.
    """
    if count == 0:
        return 0.0, 1.0
    share = successes / count
    middle = (share + z * z / (2 * count)) / (1 + z * z / count)
    half = z / (1 + z * z / count) * np.sqrt(share * (1 - share) / count + z * z / (4 * count * count))
    return float(max(0.0, middle - half)), float(min(1.0, middle + half))
