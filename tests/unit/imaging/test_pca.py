import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.geometry.rigid import rotation_x, rotation_y, rotation_z
from service.imaging.pca import (
    _lowest_of_cells,
    _moments_around,
    covariance,
    level_scan,
    principal_components,
    principal_heading,
    project,
)


def cloud(seed, dimensions=3, count=200):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(count, dimensions)) @ rng.normal(size=(dimensions, dimensions)) + rng.uniform(
        -50, 50, dimensions
    )


def street_canyon(*, heading_deg=0.0, height_m=1.8, slope=0.0, seed=0):
    """Return a road 8 m wide between two walls along the heading, seen from its centre. The ground has the slope ``slope``."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-40, 40, 9000), rng.uniform(-4, 4, 9000)
    road = np.stack([x, y, np.zeros(9000)], axis=1)
    along, side = rng.uniform(-40, 40, 6000), np.where(rng.random(6000) < 0.5, 4.0, -4.0)
    walls = np.stack([along, side + rng.normal(0, 0.1, 6000), rng.uniform(0, 6, 6000)], axis=1)
    points = np.concatenate([road, walls]) @ rotation_z(np.deg2rad(heading_deg)).T - [0, 0, height_m]
    return points @ rotation_y(slope).T


@given(st.integers(0, 500), st.integers(2, 5))
def test_covariance_is_numpys_with_the_number_of_points_below(seed, dimensions):
    points = cloud(seed, dimensions)
    np.testing.assert_allclose(covariance(points), np.cov(points, rowvar=False, bias=True), rtol=1e-9, atol=1e-9)


def test_covariance_of_two_points_by_hand():
    np.testing.assert_allclose(covariance(np.array([[0.0, 0.0], [2.0, 4.0]])), [[1, 2], [2, 4]])


@given(st.integers(0, 500))
def test_axes_are_orthonormal_and_ordered_by_variance(seed):
    found = principal_components(cloud(seed))
    np.testing.assert_allclose(found.axes.T @ found.axes, np.eye(3), atol=1e-9)
    assert (np.diff(found.variances) <= 1e-9).all()


@given(st.integers(0, 500))
def test_axes_are_eigenvectors_of_the_covariance(seed):
    points = cloud(seed)
    found = principal_components(points)
    np.testing.assert_allclose(covariance(points) @ found.axes, found.axes * found.variances, atol=1e-7)


@given(st.integers(0, 500))
def test_projected_points_are_uncorrelated_with_the_variances_on_the_diagonal(seed):
    points = cloud(seed)
    found = principal_components(points)
    np.testing.assert_allclose(covariance(project(points, found)), np.diag(found.variances), atol=1e-7)


def test_the_largest_entry_of_every_axis_is_positive():
    axes = principal_components(cloud(4)).axes
    assert (axes[np.abs(axes).argmax(axis=0), np.arange(3)] > 0).all()


@pytest.mark.parametrize("tilt_deg", [-8.0, -1.0, 0.0, 3.0, 8.0])
def test_a_tilted_scan_is_turned_level_and_its_height_found(tilt_deg):
    points = street_canyon() @ rotation_x(np.deg2rad(tilt_deg)).T
    level = level_scan(points)
    up = level.R_level_sensor @ rotation_x(np.deg2rad(tilt_deg)) @ [0, 0, 1]
    assert np.rad2deg(np.arccos(min(1.0, up[2]))) < 0.2
    assert level.height_m == pytest.approx(1.8, abs=0.03)


def test_no_height_is_negative_after_levelling():
    points = street_canyon(slope=np.deg2rad(4))
    level = level_scan(points)
    assert ((points @ level.R_level_sensor.T)[:, 2] + level.height_m).min() > -0.1


@pytest.mark.parametrize("count", [0, 5, 400])
def test_without_ground_the_sensors_own_level_at_the_expected_height_stands(count):
    sky = np.random.default_rng(0).uniform([-20, -20, 2], [20, 20, 9], (count, 3))
    level = level_scan(sky, expected_height_m=2.1)
    np.testing.assert_array_equal(level.R_level_sensor, np.eye(3))
    assert level.height_m == 2.1


@pytest.mark.parametrize("heading_deg", [-89.0, -60.0, -10.0, 0.0, 25.0, 44.0, 46.0, 80.0])
def test_the_principal_heading_is_that_of_the_street(heading_deg):
    found = principal_heading(street_canyon(heading_deg=heading_deg), height_m=1.8)
    assert abs((np.rad2deg(found) - heading_deg + 90) % 180 - 90) < 2.0


def test_the_principal_heading_lies_within_half_a_turn():
    found = [principal_heading(street_canyon(heading_deg=h), height_m=1.8) for h in range(-180, 181, 30)]
    assert all(-np.pi / 2 <= angle < np.pi / 2 for angle in found)


def test_a_scan_without_upright_things_has_heading_zero():
    flat = np.random.default_rng(0).uniform([-20, -20, -1.9], [20, 20, -1.7], (500, 3))
    assert principal_heading(flat, height_m=1.8) == 0.0


def test_the_lowest_point_of_each_cell_represents_the_ground_by_hand():
    """Cells of 1 m around (5, 5) and (6, 5), in the order of the cells. Of equally low points of a cell the first counts."""
    points = np.array(
        [
            [6.5, 5.5, -1.7],
            [5.2, 5.2, -1.6],
            [5.7, 5.1, -1.9],
            [5.6, 5.8, -1.9],
            [6.2, 5.2, -1.5],
            [5.5, 5.5, -9.0],  # far below the ground
            [1.0, 1.0, -1.8],  # on the vehicle
            [17.0, 17.0, -1.8],  # too far away
        ]
    )
    np.testing.assert_array_equal(_lowest_of_cells(points, 1.8, 1.0), points[[2, 0]])
    np.testing.assert_array_equal(
        _lowest_of_cells(points.astype(np.float32), 1.8, 1.0), points[[2, 0]].astype(np.float32)
    )


@given(seed=st.integers(0, 10**6), count=st.sampled_from([0, 1, 30, 2000]), rounded=st.booleans())
def test_the_lowest_points_are_those_of_a_sort(seed, count, rounded):
    points = np.random.default_rng(seed).normal([0, 0, -1.8], [8, 8, 0.5], (count, 3))
    points = np.round(2 * points) / 2 if rounded else points
    radius = np.hypot(points[:, 0], points[:, 1])
    near = points[(radius > 2) & (radius < 18) & (np.abs(points[:, 2] + 1.8) < 1.0 + 0.12 * radius)]
    x, y = np.floor(near[:, :2] + 18.0).T
    order = np.lexsort((near[:, 2], y, x))
    _, first = np.unique(np.stack([x, y], axis=1)[order], axis=0, return_index=True)
    np.testing.assert_array_equal(_lowest_of_cells(points, 1.8, 1.0), near[order[first]].reshape(-1, 3))


@given(seed=st.integers(0, 10**6), size=st.integers(1, 20), window=st.integers(0, 4), share=st.floats(0, 1))
def test_moments_around_a_cell_are_those_of_the_cells_in_its_window(seed, size, window, share):
    """Coordinates about the middle are multiples of a half, so the sums are exact, and so are their means in any order."""
    occupied = (np.random.default_rng(seed).random((size, size)) < share).astype(np.float64)
    row, column = np.nonzero(occupied)
    found = _moments_around(occupied, window)
    assert found.shape == (4, len(row))
    x, y = row - size / 2, column - size / 2
    for k in range(len(row)):
        inside = np.maximum(np.abs(row - row[k]), np.abs(column - column[k])) <= window
        count = inside.sum()
        mx, my = x[inside].sum() / count, y[inside].sum() / count
        xx, xy, yy = ((a[inside] * b[inside]).sum() / count for a, b in ((x, x), (x, y), (y, y)))
        np.testing.assert_array_equal(found[:, k], [count, xx - mx * mx, xy - mx * my, yy - my * my])
