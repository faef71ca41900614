import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.geometry.rigid import rotation_x, rotation_y, rotation_z
from service.imaging.pca import covariance, level_scan, principal_components, principal_heading, project


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
