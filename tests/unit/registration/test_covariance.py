import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.geometry.rigid import rotation_z
from service.registration import covariance
from service.registration.covariance import covariance_of, inflation
from service.registration.surfel_map import SurfelMap

PRIOR_SIGMA = np.array([30.0, 30.0, 0.3, *np.deg2rad([2.0, 2.0, 10.0])])
FLOOR = np.array([0.02, 0.03, 0.01, *np.deg2rad([0.02, 0.03, 0.05])])
#: Of pictures whose deviations are four times those of independent points.
NOISE = 1e-3


@pytest.fixture(autouse=True)
def counted(monkeypatch):
    """What these tests count on."""
    numbers = {"INFLATION": 4.0, "AT_NOISE": NOISE, "POWER": 0.5, "LEAST": 3.0, "MOST": 8.0, "_FLOOR": FLOOR}
    for name, value in numbers.items():
        monkeypatch.setattr(covariance, name, value)


noises = st.floats(0, 1e-2)


@pytest.mark.parametrize(
    ("noise", "expected"),
    [(1e-3, 4.0), (2.25e-3, 6.0), (4e-3, 8.0), (9e-3, 8.0), (1e-3 * 9 / 16, 3.0), (1e-4, 3.0), (0.0, 3.0)],
)
def test_the_noisier_the_picture_the_larger_the_deviations_within_limits(noise, expected):
    """By the root of the noise: 4 at a thousandth, never below 3 or above 8."""
    assert inflation(noise) == pytest.approx(expected)


@given(noises, noises)
def test_noise_never_makes_a_pose_better_known(one, other):
    less, more = (covariance_of(random_information(2, 20, 1e3), noise) for noise in sorted((one, other)))
    assert np.linalg.eigvalsh(more - less).min() > -1e-9


def random_information(seed, rows, scale):
    """Of so many points of random gradients."""
    gradients = np.random.default_rng(seed).normal(size=(rows, 8))
    return scale * gradients.T @ gradients


informations = st.builds(
    random_information, st.integers(0, 10**6), st.integers(0, 20), st.sampled_from([1.0, 1e3, 1e6])
)


@given(informations, noises)
def test_a_covariance_is_symmetric_and_positive_definite(information, noise):
    found = covariance_of(information, noise)
    np.testing.assert_array_equal(found, found.T)
    assert np.linalg.eigvalsh(found - 0.99 * np.diag(FLOOR**2)).min() > 0


@given(informations, informations, noises)
def test_more_information_means_less_variance_in_every_direction(information, more, noise):
    gained = covariance_of(information, noise) - covariance_of(information + more, noise)
    assert np.linalg.eigvalsh(gained).min() > -1e-6


def test_more_information_about_every_unknown_means_strictly_less_variance():
    information = random_information(1, 20, 1e3)
    variances = [np.diag(covariance_of(factor * information, NOISE)) for factor in (1, 4, 16)]
    assert (variances[0] > variances[1]).all()
    assert (variances[1] > variances[2]).all()


def test_without_information_what_is_known_beside_the_points_remains():
    expected = np.diag(PRIOR_SIGMA**2 + FLOOR**2)
    np.testing.assert_allclose(covariance_of(np.zeros((8, 8)), NOISE), expected, rtol=1e-9)


def test_endless_information_leaves_the_floor_of_each_axis():
    np.testing.assert_allclose(covariance_of(1e15 * np.eye(8), NOISE), np.diag(FLOOR**2), rtol=1e-3, atol=1e-12)


def test_deviations_are_inflated_over_those_of_independent_points():
    """A centimetre of independent points is four of ours, six of a noisier picture; then come those of the floor."""
    for noise, times in ((NOISE, 4.0), (2.25 * NOISE, 6.0)):
        found = np.sqrt(np.diag(covariance_of(1e4 * np.eye(8), noise))[:2])
        np.testing.assert_allclose(found, np.hypot(times * 0.01, FLOOR[:2]), rtol=1e-3)


def test_an_unknown_scale_costs_certainty():
    """Points that only know the sum of x and the log scale know x no better than the scale, by 0.01."""
    information = np.zeros((8, 8))
    information[np.ix_([0, 6], [0, 6])] = 1e8
    x = covariance_of(information, NOISE)[0, 0]
    assert np.sqrt(x - FLOOR[0] ** 2) == pytest.approx(0.01, rel=0.01)


@pytest.mark.parametrize("heading_deg", [0, 30, 120])
def test_in_a_corridor_the_position_along_it_is_the_least_known(scene_of, start_at, settle, heading_deg):
    R = rotation_z(np.deg2rad(heading_deg))
    flat = [
        ((-30, -4, 0), (60, 0, 0), (0, 8, 0)),
        ((-30, -4, 0), (60, 0, 0), (0, 0, 6)),
        ((-30, 4, 0), (60, 0, 0), (0, 0, 6)),
    ]
    corridor = scene_of(*(tuple(R @ np.array(each, float) for each in rectangle) for rectangle in flat))
    surfels = corridor.surfels(0.5)
    cloud = SurfelMap.prepare(np.zeros(3), surfels, np.array([[0.0, 0, 0, len(surfels)]]))
    camera = np.array([0, 0, 1.5])
    points = corridor.points(R, camera)
    state = settle(cloud, points.subset(np.flatnonzero(np.linalg.norm(points.xyz, axis=1) < 25)), start_at(R, camera))
    found = covariance_of(state["information"][0], NOISE)
    variances, axes = np.linalg.eigh(found[:3, :3])
    assert abs(axes[:, 2] @ R[:, 0]) > 0.999
    assert variances[2] > 1000 * variances[1]
    assert np.sqrt(variances[1]) < 0.05
