"""Errors of a triangulating camera are uniform in 1 / range. Points measured too near must not get larger weights."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.geometry.rigid import rotation_z
from service.registration.kernel import SURFEL, Piece, SolverOptions, align, packed_map

#: A fixture of two values: grid and surfels, or rotation and position.
Pair = tuple[Any, Any]

#: No robust kernel, no surface's roughness: the points' own noise is all there is.
FREE: dict[str, Any] = {"reach": 1.2, "robust_first": 1e6, "robust_last": 1e6, "surface": 0.0, "prior_weight": 0.0}


@pytest.fixture(scope="module")
def one_surfel():
    """Return a map with one surfel at the origin that faces x."""
    surfels = np.zeros(1, SURFEL)
    surfels["normal"] = [1, 0, 0]
    return packed_map(surfels, cell_m=0.3, reach_m=1.2)[:2]


def known(one_surfel: Pair, points, start, **options):
    """Return the information about x after one iteration."""
    align((Piece(*one_surfel),), points, start, SolverOptions(**(FREE | options), iterations=1))
    return start["information"][0, 0, 0]


@pytest.mark.parametrize(
    ("measured_m", "there_m", "ratio"),
    [
        (5.0, 5.0, 1.0),
        (5.0, 4.0, 0.8),  # seen too far
        (4.0, 5.0, 1.25),  # seen too near
        (1.6, 0.8, 0.5),
        (1.6, 0.5, 0.5),  # half and double are the bounds
        (0.6, 1.2, 2.0),
        (0.6, 1.5, 2.0),
        (0.6, -0.3, 0.5),  # the surface lies behind the camera
    ],
)
def test_the_variance_is_that_at_the_range_of_the_intersection(
    one_surfel, points_at, start_at, measured_m, there_m, ratio
):
    """The variance is scaled by the cube of the ratio. Then weight times residual is an odd function of the error of 1 / range."""
    found = known(one_surfel, points_at([[measured_m, 0, 0]], sigma=0.2), start_at(np.eye(3), [-there_m, 0, 0]))
    assert found == pytest.approx(1 / (0.04 * ratio**3), rel=1e-4)


def test_only_the_range_variance_is_scaled_by_its_component_along_the_normal(one_surfel, points_at, start_at):
    """The ray (4, 3, 0) / 5 measures 5 m and hits the wall at 4 m. Sigma 0.5 gives 0.4 across the wall. Its variance is scaled by
    0.8^3. The roughness of 0.3 is not scaled.
    """
    start = start_at(np.eye(3), [-3.2, -2.8, 0])
    found = known(one_surfel, points_at([[4, 3, 0]], sigma=0.5), start, surface=0.3)
    assert found == pytest.approx(1 / (0.16 * 0.8**3 + 0.09), rel=1e-4)


def test_the_range_is_the_one_that_scale_and_offset_make_of_the_measured_one(one_surfel, points_at, start_at):
    """4 m become 5 m at scale 1.25, or if 20 px of disparity are truly 16 px. The ratio for a wall at 5 m is 1."""
    points = points_at([[4.0, 0, 0]], sigma=0.2, focal_baseline_px_m=80.0)
    for changed in ({"log_scale": np.log(1.25)}, {"offset": -4.0}):
        assert known(one_surfel, points, start_at(np.eye(3), [-5, 0, 0], **changed)) == pytest.approx(25, rel=1e-4)


@pytest.mark.parametrize("before_m", [0.1, 0.0, -0.1])
def test_a_ray_parallel_to_the_surface_gives_no_range(one_surfel, points_at, start_at, before_m):
    """The ray is parallel to the surface, or in it. Only the roughness remains, and there is no division by zero."""
    start = start_at(np.eye(3), [before_m, 0, 0])
    found = known(one_surfel, points_at([[0, 0.5, 0]], sigma=0.2), start, surface=0.1)
    assert found == pytest.approx(100, rel=1e-4)


@pytest.fixture(scope="module")
def wall(scene_of):
    """Return a wall perpendicular to x, 8 x 8 m about the origin, without thickness."""
    surfels = scene_of(((0, -4, -4), (0, 8, 0), (0, 0, 8))).surfels()
    surfels["thickness_m"] = 0
    return packed_map(surfels, cell_m=0.4, reach_m=1.2)[:2]


def seen_twice(points_at, distance_m, error):
    """Return each point of the wall twice: with 1 / range too large and too small by a share. Sigma grows with range squared."""
    y, z = (each.ravel() for each in np.meshgrid(np.linspace(-1, 1, 7), np.linspace(-1, 1, 7)))
    true = np.stack([np.full(y.size, distance_m), 0.3 * distance_m * y, 0.3 * distance_m * z], axis=1)
    measured = np.concatenate([true / (1 + error), true / (1 - error)])
    sigma = 0.02 * (np.linalg.norm(measured, axis=1)) ** 2
    return replace(points_at(measured), sigma=sigma.astype(np.float32))


def drawn_nearer_m(distance_m, error):
    """Return the bias towards the camera if each point had the weight of its measured range, metres.

    Ranges 1 / (1 +- e) have weights (1 +- e)^4: their mean is (1 + 3 e^2) / (1 + 6 e^2 + e^4).
    """
    return distance_m * (1 - (1 + 3 * error**2) / (1 + 6 * error**2 + error**4))


@given(st.floats(2.0, 5.0), st.floats(0.05, 0.15), st.floats(-0.05, 0.05), st.floats(-3, 3))
def test_noise_that_is_even_in_inverse_range_draws_no_wall_nearer(
    wall, points_at, start_at, distance_m, error, off_m, heading
):
    """Along the ray, the bias of the camera is far smaller than with weights from measured ranges.

    The scale is fixed, because noise that is symmetric in 1 / range is not symmetric for a scale. Position and rotation are free.
    """
    R = rotation_z(heading)
    surfels = wall[0].unpacked(wall[1], np.arange(len(wall[1])))
    surfels["xyz"], surfels["normal"] = surfels["xyz"] @ R.T.astype("f4"), surfels["normal"] @ R.T.astype("f4")
    turned = packed_map(surfels, cell_m=0.4, reach_m=1.2)[:2]
    start = start_at(R, R @ [off_m - distance_m, 0, 0])
    options = SolverOptions(**(FREE | {"prior_weight": 1e-6}), iterations=10, free_scale=False)
    align((Piece(*turned),), seen_twice(points_at, distance_m, error), start, options)
    too_far_ahead = float(R[:, 0] @ start["t"][0]) + distance_m
    bias = drawn_nearer_m(distance_m, error)
    assert bias > 0.01
    assert abs(too_far_ahead) < 0.05 * bias


@pytest.mark.parametrize("distance_m", [2.5, 4.0, 5.0])
def test_a_narrow_robust_kernel_damps_both_signs_of_the_noise_equally(wall: Pair, points_at, start_at, distance_m):
    """Errors are 0.8 standard deviations. For larger errors, a redescending kernel may select one half."""
    start = start_at(np.eye(3), [0.01 - distance_m, 0, 0])
    kernel = {"robust_first": 1e-3, "robust_last": 1e-3, "prior_weight": 1e-6}
    options = SolverOptions(**(FREE | kernel), iterations=30, free_scale=False)
    error = 0.8 * 0.02 * distance_m
    align((Piece(*wall),), seen_twice(points_at, distance_m, error), start, options)
    assert abs(float(start["t"][0][0]) + distance_m) < 0.05 * drawn_nearer_m(distance_m, error)
