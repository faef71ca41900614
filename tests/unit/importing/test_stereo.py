"""Depth of a rectified pair: a shifted image has the same disparity everywhere."""

import numpy as np
import pytest

from model_training.importing.stereo import StereoMatching, depth_from_stereo

FOCAL_BASELINE = 80.0
MATCHING = StereoMatching(disparities=64)


def pair(disparity: int, *, width: int = 320, height: int = 120) -> tuple[np.ndarray, np.ndarray]:
    """Return a textured plane parallel to both image planes."""
    texture = np.random.default_rng(0).integers(0, 255, (height, width + disparity, 3), np.uint8)
    return texture[:, :width].copy(), texture[:, disparity:].copy()


@pytest.mark.parametrize("disparity", [4, 20])
def test_the_left_of_the_picture_is_measured_where_the_right_picture_shows_it(disparity: int) -> None:
    left, right = pair(disparity)
    depth_m = depth_from_stereo(left, right, focal_baseline_px_m=FOCAL_BASELINE, matching=MATCHING)
    shown = depth_m[:, disparity + MATCHING.block :]
    assert (shown > 0).mean() > 0.95
    assert np.median(shown[shown > 0]) == pytest.approx(FOCAL_BASELINE / disparity, rel=0.01)
    assert depth_m.shape == left.shape[:2]


def test_no_match_is_taken_from_beyond_the_right_picture() -> None:
    """A pixel of column u has no disparity larger than u."""
    left, right = pair(20)
    depth_m = depth_from_stereo(left, right, focal_baseline_px_m=FOCAL_BASELINE, matching=MATCHING)
    v, u = np.nonzero(depth_m)
    assert (FOCAL_BASELINE / depth_m[v, u] <= u + 1e-3).all()
    assert not depth_m[:, :4].any()
