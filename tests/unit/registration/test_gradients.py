"""The gradients of the patches of an image. ``test_jacobian`` compares derivatives with numerical ones."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.geometry.rigid import rotation_z
from service.registration.kernel import SURFEL, Piece, SolverOptions, align, gradients, packed_map

#: A fixture of two values: grid and surfels, or rotation and position.
Pair = tuple[Any, Any]

OPTIONS = SolverOptions(iterations=1, reach=1.0, robust_first=1e6, robust_last=1e6, surface=0.1)


@pytest.fixture(scope="module")
def wall():
    """Return grid and surfel of a map with one surfel at the origin that faces x."""
    surfels = np.zeros(1, SURFEL)
    surfels["normal"] = [1, 0, 0]
    return packed_map(surfels, cell_m=0.3, reach_m=1.2)[:2]


@pytest.fixture(scope="module")
def ground(scene_of):
    """Return a ground of 12 x 12 m about the origin."""
    surfels = scene_of(((-6, -6, 0), (12, 0, 0), (0, 12, 0))).surfels()
    return packed_map(surfels, cell_m=0.4, reach_m=1.2)[:2]


def numbers(*patch):
    return np.array(patch, np.int32)


def test_the_gradient_of_a_point_by_hand(wall: Pair, points_at, start_at):
    """The point is 0.1 m behind the wall with sigma 0.1 m: weight 100, so 10 per unit of the derivative.

    Derivatives: the normal; (5.1, 0.3, -0.2) x (1, 0, 0) = (0, -0.2, -0.3); 5.1 for the scale; -5.1 x 5.1 / 80 for the offset.
    """
    point = points_at([[5.1, 0.3, -0.2]], sigma=0.0, focal_baseline_px_m=80.0)
    found = gradients((Piece(*wall),), point, start_at(np.eye(3), [-5.0, 0, 0]), OPTIONS, numbers(0))
    expected = [[10, 0, 0, 0, -2, -3, 51, -51 * 5.1 / 80]]
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4)


def test_gradients_of_opposite_residuals_cancel_in_one_patch_but_not_in_two(wall: Pair, points_at, start_at):
    """The points are 0.1 m behind and 0.1 m in front of the wall. They cancel in one patch, but not in two."""
    points = points_at([[5.1, 0.3, 0], [4.9, 0.3, 0]], sigma=0.0, weight=[1, 3])
    start = start_at(np.eye(3), [-5.0, 0, 0])
    together = gradients((Piece(*wall),), points, start, OPTIONS, numbers(0, 0))
    apart = gradients((Piece(*wall),), points, start, OPTIONS, numbers(1, 0))
    np.testing.assert_allclose(together[:, 0], [-20], rtol=1e-4)
    np.testing.assert_allclose(apart[:, 0], [-30, 10], rtol=1e-4)
    np.testing.assert_allclose(apart.sum(axis=0), together[0], rtol=1e-12)


@pytest.mark.parametrize(
    ("robust_m", "weight"), [(1e6, 100.0), (0.3, 100 * (0.13 / 0.14) ** 2), (1e-6, 100 * (0.04 / 0.05) ** 2)]
)
def test_the_robust_width_is_that_of_the_last_iteration(wall: Pair, points_at, start_at, robust_m, weight):
    """The first width has no effect. The point is 0.1 m off, as in ``test_jacobian``."""
    options = replace(OPTIONS, robust_first=5.0, robust_last=robust_m, iterations=8)
    found = gradients(
        (Piece(*wall),), points_at([[5.1, 0, 0]], sigma=0.0), start_at(np.eye(3), [-5.0, 0, 0]), options, numbers(0)
    )
    assert found[0, 0] == pytest.approx(0.1 * weight, rel=1e-4)


def test_points_on_their_surface_have_no_gradient(ground: Pair, points_at, start_at):
    """For points on their surface in any arrangement, the gradient is 0 and the information is not."""
    xy = np.random.default_rng(1).uniform(-5, 5, (100, 2))
    points, start = points_at(np.c_[xy, np.full(100, -1.5)]), start_at(rotation_z(0.3), [0, 0, 1.5])
    found = gradients((Piece(*ground),), points, start, OPTIONS, np.arange(100, dtype=np.int32) % 7)
    np.testing.assert_array_equal(found, np.zeros((7, 8)))
    align((Piece(*ground),), points, start, OPTIONS)
    assert start["information"][0, 2, 2] > 100


def test_points_without_a_surface_in_reach_have_no_gradient(ground: Pair, points_at, start_at):
    """The last three points: 0.6 m above the ground with a limit of 0.5 m, beyond the grid, and with weight 0."""
    near, start = [[1.0, 1, -1.4], [2, -2, -1.6]], start_at(np.eye(3), [0, 0, 1.5])
    options = replace(OPTIONS, reach=0.5)
    points = points_at([*near, [1, 0, -0.9], [500, 0, 0], [0, 1, -1.4]], weight=[1, 1, 1, 1, 0])
    found = gradients((Piece(*ground),), points, start, options, numbers(0, 1, 2, 2, 2))
    np.testing.assert_array_equal(found[2], np.zeros(8))
    np.testing.assert_array_equal(
        found[:2], gradients((Piece(*ground),), points_at(near), start, options, numbers(0, 1))
    )
    assert found[0, 2] > 0 > found[1, 2]
    assert gradients((Piece(*ground),), points, start, replace(OPTIONS, reach=1.0), numbers(0, 1, 2, 2, 2))[2, 2] > 0


def test_no_points_are_no_patches(ground: Pair, points_at, start_at):
    none = points_at(np.zeros((0, 3)))
    assert gradients((Piece(*ground),), none, start_at(np.eye(3), [0, 0, 1.5]), OPTIONS, numbers()).shape == (0, 8)


@given(st.integers(0, 10**6), st.integers(1, 200), st.integers(1, 40))
def test_the_gradients_of_all_patches_sum_to_that_of_the_image(street_map, seen, pose, start_at, seed, count, cut):
    """The gradient of a patch does not depend on the other patches."""
    rng = np.random.default_rng(seed)
    points = seen.subset(rng.permutation(len(seen))[:count])
    patch = np.unique(rng.integers(0, cut, count), return_inverse=True)[1].astype(np.int32)
    start = start_at(rotation_z(0.02) @ pose[0], pose[1] + [0.2, -0.1, 0.05], log_scale=0.002, offset=0.05)
    asked = street_map.grid, street_map.surfels
    found = gradients((Piece(*asked),), points, start, OPTIONS, patch)
    whole = gradients((Piece(*asked),), points, start, OPTIONS, np.zeros(count, np.int32))
    assert found.shape == (patch.max() + 1, 8)
    np.testing.assert_allclose(found.sum(axis=0), whole[0], rtol=1e-9, atol=1e-6)
    rows = np.flatnonzero(patch == patch[0])
    alone = gradients((Piece(*asked),), points.subset(rows), start, OPTIONS, np.zeros(len(rows), np.int32))
    np.testing.assert_allclose(found[patch[0]], alone[0], rtol=1e-9, atol=1e-6)
