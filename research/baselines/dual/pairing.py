"""Assignment of frames to images, and the choice of held-out images."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

PAIR_REACH_M = 2.0
WATCH_RADIUS_M, WATCH_SHARE = 8.0, 0.05


def frames_near(pictures_xy: NDArray[np.float64], frames_xy: NDArray[np.float64]) -> list[NDArray[np.int64]]:
    """Return, for each image, the rows of the frames within ``PAIR_REACH_M``; possibly none.

    Args:
        pictures_xy: positions of the images (n, 2), metres.
        frames_xy: positions of the frames (m, 2), metres.
    """
    near = cKDTree(frames_xy).query_ball_point(pictures_xy, PAIR_REACH_M, return_sorted=True)
    return [np.array(rows, np.int64) for rows in near]


def watched(xy: NDArray[np.float64], rng: np.random.Generator, share: float = WATCH_SHARE) -> NDArray[np.bool_]:
    """Return which positions (n,) are held out: all within some circles, so that whole pieces of street are unseen.

    The function draws circles around random positions until they hold ``share`` of all. It ignores lane and traversal,
    so training sees nothing near the centre of a circle.

    Args:
        xy: positions (n, 2), metres.
        rng: source of randomness.
        share: share of positions to hold out.
    """
    tree, held = cKDTree(xy), np.zeros(len(xy), np.bool_)
    for centre in rng.permutation(len(xy)):
        if held.sum() >= share * len(xy):
            break
        held[tree.query_ball_point(xy[centre], WATCH_RADIUS_M)] = True
    return held
