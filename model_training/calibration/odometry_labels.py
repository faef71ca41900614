"""Label answers without ground truth: neighbouring answers and the odometry between them give each frame a reference position.

Each neighbour predicts the pose of a frame: its own answer, moved by the odometry. Predictions of right answers agree with each other.
Those of wrong answers scatter. So the largest group of agreeing predictions is the reference. The frame's own answer takes no part.

The label of an answer is right if it is certainly within 1 m of the reference, and wrong if it is certainly further away. "Certainly" means
two standard deviations of the reference. Between both limits there is no label.

Limits: a perceptual alias that holds for several consecutive frames looks like a right group. An offset that all answers share is
unobservable. Decision 0150 measures both on frames with ground truth.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.geometry.rigid import inverse
from service.maps.calibration import RIGHT_M

#: Largest travelled distance to a neighbour, metres, and the largest number of neighbours.
WINDOW_M, NEIGHBOURS = 30.0, 20
#: Smallest number of neighbours whose predictions agree.
AGREEING = 3
#: Predictions agree within this many standard deviations of their difference, but never if they are further apart than ``APART_M``.
SIGMAS, APART_M = 3.0, 2.0 * RIGHT_M
#: Largest difference of the headings of agreeing predictions, radians.
APART_RAD = float(np.deg2rad(10.0))
#: Least standard deviation of an answer, metres and radians. The covariance does not contain errors of the survey.
FLOOR_M, FLOOR_RAD = 0.1, float(np.deg2rad(0.5))
#: Number of standard deviations of the reference that a label keeps from the limit of 1 m.
MARGIN = 2.0
#: Share of wrong labels that the fit of the correction assumes (decision 0150).
LABEL_NOISE = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class Labels:
    """Labels of the answers of one query set.

    Attributes:
        right: whether the answer is certainly right (n,).
        wrong: whether the answer is certainly wrong (n,). A frame that is neither has no label.
        reference_xy: reference position of each frame, map frame, metres; NaN if there is none (n, 2).
        sigma_m: standard deviation of the reference, metres; NaN if there is none (n,).
    """

    right: NDArray[np.bool_]
    wrong: NDArray[np.bool_]
    reference_xy: NDArray[np.float64]
    sigma_m: NDArray[np.float64]


def labels_by_odometry(
    T_answer: NDArray[np.float64], covariance: NDArray[np.float64], T_odom_camera: NDArray[np.float64], noise: float
) -> Labels:
    """Label the answers of consecutive frames.

    Args:
        T_answer: T_map_camera of each answer; NaN without an answer (n, 4, 4).
        covariance: covariance of each answer: translation (m), then rotation (rad), map axes; NaN if there is none (n, 6, 6).
        T_odom_camera: pose of each camera by the odometry, in any fixed frame (n, 4, 4).
        noise: standard deviation of the odometry's end point, as a share of the travelled distance.
    """
    count = len(T_answer)
    sigma_m, sigma_rad = _deviations(covariance)
    answered = np.isfinite(T_answer).all(axis=(1, 2))
    steps = np.linalg.norm(np.diff(T_odom_camera[:, :3, 3], axis=0), axis=1)
    way = np.concatenate([[0.0], np.cumsum(steps)])[:count]
    T_reference = np.full((count, 4, 4), np.nan)
    reference_m, reference_rad = np.full(count, np.nan), np.full(count, np.nan)
    for k in range(count):
        others = np.flatnonzero(answered & (np.abs(way - way[k]) <= WINDOW_M) & (np.arange(count) != k))
        others = others[np.argsort(np.abs(way[others] - way[k]), kind="stable")[:NEIGHBOURS]]
        T, error = _predictions(k, others, T_answer, sigma_m, sigma_rad, T_odom_camera, way, noise)
        group = _agreeing(T, error)
        if group is not None:
            best = int(group[int(np.argmin(error[group]))])
            T_reference[k] = T[best]
            T_reference[k, :2, 3] = np.average(T[group, :2, 3], axis=0, weights=error[group] ** -2)
            reference_m[k], reference_rad[k] = error[best], sigma_rad[others[best]]
    # Frames whose neighbours do not agree, such as those outside the map: from the nearest frame with a reference.
    known = np.flatnonzero(np.isfinite(reference_m))
    T_known, known_m = T_reference.copy(), reference_m.copy()
    for lost in np.flatnonzero(~np.isfinite(reference_m)) if len(known) else ():
        T, error = _predictions(int(lost), known, T_known, known_m, reference_rad, T_odom_camera, way, noise)
        nearest = int(np.argmin(error))
        T_reference[lost], reference_m[lost] = T[nearest], error[nearest]
    off = np.linalg.norm(T_answer[:, :2, 3] - T_reference[:, :2, 3], axis=1)  # NaN compares as False
    right = off + MARGIN * reference_m <= RIGHT_M
    wrong = off - MARGIN * reference_m > RIGHT_M
    return Labels(right, wrong, T_reference[:, :2, 3], reference_m)


def _deviations(covariance: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the larger horizontal standard deviation (m) and that of the heading (rad) of each answer, with their floors."""
    known = np.where(np.isfinite(covariance), covariance, 0.0)
    horizontal = np.linalg.eigvalsh(known[:, :2, :2])[:, -1]
    return np.sqrt(horizontal + FLOOR_M**2), np.sqrt(known[:, 5, 5] + FLOOR_RAD**2)


def _predictions(
    k: int,
    others: NDArray[np.int64],
    T_map: NDArray[np.float64],
    sigma_m: NDArray[np.float64],
    sigma_rad: NDArray[np.float64],
    T_odom: NDArray[np.float64],
    way: NDArray[np.float64],
    noise: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the poses of frame ``k`` that other frames predict (m, 4, 4), and their horizontal standard deviations, metres (m,)."""
    motion = [inverse(T_odom[j]) @ T_odom[k] for j in others]
    T = np.array([T_map[j] @ step for j, step in zip(others, motion, strict=True)]).reshape(-1, 4, 4)
    lever = np.array([np.linalg.norm(step[:3, 3]) for step in motion])
    error = np.sqrt(sigma_m[others] ** 2 + (sigma_rad[others] * lever) ** 2 + (noise * (way[others] - way[k])) ** 2)
    return T, error.reshape(-1)


def _agreeing(T: NDArray[np.float64], error: NDArray[np.float64]) -> NDArray[np.int64] | None:
    """Return the indices of the largest group of agreeing predictions; None if it is too small, or if another has more than half of it."""
    if len(T) < AGREEING:
        return None
    apart = np.linalg.norm(T[:, None, :2, 3] - T[None, :, :2, 3], axis=2)
    heading = np.arctan2(T[:, 1, 2], T[:, 0, 2])  # of the optical axis
    turned = np.abs((heading[:, None] - heading[None] + np.pi) % (2 * np.pi) - np.pi)
    limit = np.minimum(SIGMAS * np.sqrt(error[:, None] ** 2 + error[None] ** 2), APART_M)
    agree = (apart <= limit) & (turned <= APART_RAD)
    members = agree.sum(axis=1)
    first = int(np.argmax(members))
    if members[first] < AGREEING:
        return None
    against = ~agree[first]
    if against.any() and 2 * (agree[against] & against).sum(axis=1).max() > members[first]:
        return None
    return np.flatnonzero(agree[first])
