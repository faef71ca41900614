"""Which frames belong to a picture, and which pictures are kept from the training to watch it."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

PAIR_REACH_M = 2.0
WATCH_RADIUS_M, WATCH_SHARE = 8.0, 0.05


def frames_near(pictures_xy: NDArray[np.float64], frames_xy: NDArray[np.float64]) -> list[NDArray[np.int64]]:
    """For each picture (n, 2) the frames (m, 2) it may be paired with: those within ``PAIR_REACH_M``, maybe none."""
    near = cKDTree(frames_xy).query_ball_point(pictures_xy, PAIR_REACH_M, return_sorted=True)
    return [np.array(rows, np.int64) for rows in near]


def watched(xy: NDArray[np.float64], rng: np.random.Generator, share: float = WATCH_SHARE) -> NDArray[np.bool_]:
    """Which positions (n, 2) are not shown: all that lie in some circles, so that whole pieces of street are unseen.

    Circles are drawn about positions by chance until they hold ``share`` of all. They do not ask which lane or drive a
    picture is of, so nothing near the middle of one is shown.
    """
    tree, held = cKDTree(xy), np.zeros(len(xy), np.bool_)
    for centre in rng.permutation(len(xy)):
        if held.sum() >= share * len(xy):
            break
        held[tree.query_ball_point(xy[centre], WATCH_RADIUS_M)] = True
    return held
