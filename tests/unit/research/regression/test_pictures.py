from dataclasses import replace

import numpy as np
import pytest

from research.baselines.regression.pictures import (
    DEPTH_UNIT_M,
    GREY,
    SPREAD,
    Jitter,
    MapFrame,
    planes_of,
    poses_of,
    transforms_of,
    watched_rows,
)
from service.errors import DatasetError


def test_poses_come_back_as_they_were(pairs_in_hall):
    T = pairs_in_hall(5).T_map_camera
    frame = MapFrame.of(T[:, :3, 3])
    np.testing.assert_allclose(transforms_of(poses_of(T, frame), frame), T, atol=1e-4)


def test_normalised_positions_have_mean_zero_and_spread_one_along_the_wider_axis():
    xyz = np.array([[0.0, 1.0, 5.0], [10.0, 2.0, 5.0]])
    frame = MapFrame.of(xyz)
    assert frame == MapFrame((5.0, 1.5, 5.0), 5.0)
    np.testing.assert_allclose(frame.normalised(xyz), [[-1, -0.1, 0], [1, 0.1, 0]])


def test_planes_are_normalised_colours_and_depth(pairs_in_hall):
    pairs = pairs_in_hall(2)
    pairs.rgb[1], pairs.depth_mm[1] = (255, 0, 51), 10_000
    pairs.depth_mm[1, :112] = 0
    planes = planes_of(pairs, np.array([1]), 56)[0].numpy()
    np.testing.assert_allclose(planes[:3, 5, 5], (np.array([1.0, 0.0, 0.2]) - GREY) / SPREAD, rtol=1e-5)
    np.testing.assert_allclose(planes[3, :28], 0.0)
    np.testing.assert_allclose(planes[3, 28:], 10.0 / DEPTH_UNIT_M)


def test_jitter_changes_colours_and_leaves_the_pairs_alone(pairs_in_hall):
    pairs, rows = pairs_in_hall(2), np.array([0, 1])
    before = pairs.rgb.copy()
    plain = planes_of(pairs, rows, 32)
    jittered = planes_of(pairs, rows, 32, jitter=Jitter(), rng=np.random.default_rng(0))
    assert (plain != jittered).any()
    np.testing.assert_array_equal(pairs.rgb, before)
    assert (planes_of(pairs, rows, 32, jitter=Jitter()) == plain).all()


def test_a_square_is_kept_back_whole_or_not_at_all(pairs_in_hall):
    pairs = pairs_in_hall(40)
    kept_back = watched_rows(pairs)
    assert 2 <= kept_back.sum() <= 12
    square = np.floor(pairs.T_map_camera[:, :2, 3] / 10.0).astype(int)
    for each in np.unique(square, axis=0):
        inside = kept_back[(square == each).all(axis=1)]
        assert inside.all() or not inside.any()
    np.testing.assert_array_equal(kept_back, watched_rows(pairs))


def test_pairs_of_one_square_cannot_be_kept_back(pairs_in_hall):
    pairs = pairs_in_hall(3)
    with pytest.raises(DatasetError, match="too close together"):
        watched_rows(replace(pairs, T_map_camera=np.tile(pairs.T_map_camera[:1], (3, 1, 1))))
