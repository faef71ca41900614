from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.registration.covariance import PATCH_RAD, patches, score_outer_product, variance_inflation
from service.registration.kernel import align, gradients
from service.registration.register import Registered, RegistrationSettings
from service.registration.surfel_map import SurfelMap

ORIGIN = np.array([500.0, -300.0, 40.0])
SETTINGS = RegistrationSettings()
#: Without the robust kernel, the roughness or the weights of the search: the points' own noise and number are all there is.
PLAIN = replace(SETTINGS, fine_weight=0.0, fine=replace(SETTINGS.fine, robust_first=1e6, robust_last=1e6, surface=1e-3))


def rays(azimuth_rad, elevation_rad):
    a, e = np.broadcast_arrays(azimuth_rad, elevation_rad)
    return np.stack([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)], axis=-1).reshape(-1, 3).astype("f4")


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        ((0.01, 0.01), (0.19, 0.19), True),
        ((0.19, 0.1), (0.21, 0.1), False),
        ((0.1, 0.19), (0.1, 0.21), False),
        ((-0.01, 0.1), (0.01, 0.1), False),  # the cells on either side of straight ahead are two
        ((-0.01, -0.01), (-0.19, -0.19), True),
        ((0.1, 0.1), (0.1, -0.1), False),
        ((2.5, -0.5), (2.5, -0.5), True),
        ((3.1, 0.1), (-3.1, 0.1), False),
        ((-0.1, 1.5), (0.1, -1.5), False),
        ((0.1, -1.5), (-0.1, 1.5), False),
    ],
)
def test_rays_of_a_fifth_of_a_radian_share_a_patch(one, other, same):
    assert PATCH_RAD == 0.2
    first, second = patches(np.concatenate([rays(*one), rays(*other)]))
    assert (first == second) == same


@given(st.integers(0, 10**6), st.integers(0, 300), st.sampled_from([0.1, 0.5, np.pi]))
def test_patches_are_numbered_without_gaps_and_hold_the_rays_of_one_cell(seed, count, wide):
    """All directions are tested, except those so close to a bound that rounding decides."""
    rng = np.random.default_rng(seed)
    cell = np.stack([rng.integers(-15, 15, count), rng.integers(-7, 7, count)], axis=1)
    cell = np.rint(cell * wide / np.pi).astype(int)
    azimuth, elevation = ((cell + rng.uniform(0.01, 0.99, cell.shape)) * 0.2).T
    found = patches(rays(azimuth, elevation))
    assert found.dtype == np.int32
    assert np.unique(found).tolist() == list(range(len({tuple(each) for each in cell.tolist()})))
    together = found[:, None] == found[None, :]
    np.testing.assert_array_equal(together, (cell[:, None] == cell[None, :]).all(axis=2))


def test_straight_up_and_down_are_directions_too():
    """Rounding may make the vertical component larger than 1."""
    longer = np.nextafter(np.float32(1), np.float32(2))
    found = patches(np.array([[0, 0, 1], [0, 0, longer], [0, 0, -1], [0, 0, -longer]], np.float32))
    assert found[0] == found[1]
    assert found[2] == found[3]
    assert found[0] != found[2]


@pytest.fixture(scope="module")
def city(street):
    """Return the street as a map with another origin."""
    surfels = street.surfels()
    return SurfelMap.prepare(ORIGIN, surfels)


@pytest.fixture(scope="module")
def wrong(seen):
    """Return points of the street with errors of their sigma and various weights."""
    rng = np.random.default_rng(3)
    sigma, weight = rng.uniform(0.02, 0.2, len(seen)), rng.choice([0.1, 1.0], len(seen))
    off = (sigma * rng.normal(size=len(seen)))[:, None].astype("f4")
    q = rng.uniform(0.02, 0.3, len(seen))
    return replace(
        seen, xyz=seen.xyz + off * seen.ray, sigma=sigma.astype("f4"), weight=weight.astype("f4"), q=q.astype("f4")
    )


def registered(pose, *, scale=1.0, offset=0.0, away=0.0):
    R, t = pose
    return Registered(R, ORIGIN + t + away, scale, offset, 0.9, np.eye(8), 0)


def by_patch(city, points, start, options):
    """Return the gradient of each patch, computed separately."""
    number = patches(points.ray)
    parts = [points.subset(np.flatnonzero(number == each)) for each in range(number.max() + 1)]
    return [gradients(city.pieces, p, start, options, np.zeros(len(p), np.int32))[0] for p in parts]


@given(st.integers(0, 10**6), st.integers(1, 400), st.floats(0.97, 1.03), st.floats(-0.2, 0.2))
@settings(max_examples=30)
def test_scatter_is_the_sum_of_outer_products_of_patch_gradients(
    city, wrong, pose, start_at, seed, count, scale, offset
):
    """At the registered pose, scale and offset, with the last options. The least weight of the last stage applies."""
    points = wrong.subset(np.sort(np.random.default_rng(seed).permutation(len(wrong))[:count]))
    start = start_at(*pose, log_scale=np.log(scale), offset=offset)
    each = by_patch(city, points.with_least_weight(0.5), start, SETTINGS.fine)
    expected = np.zeros((8, 8))
    for pull in each:
        expected += np.outer(pull, pull)
    expected *= len(each) / max(len(each) - 8, 1)
    found = score_outer_product(
        city, points, registered(pose, scale=scale, offset=offset), replace(SETTINGS, fine_weight=0.5)
    )
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-9 * np.abs(expected).max())


@given(st.integers(0, 10**6), st.integers(1, 400), st.floats(-0.3, 0.3))
@settings(max_examples=30)
def test_scatter_is_symmetric_and_nowhere_negative(city, wrong, pose, seed, count, away):
    points = wrong.subset(np.random.default_rng(seed).permutation(len(wrong))[:count])
    found = score_outer_product(city, points, registered(pose, away=away), SETTINGS)
    np.testing.assert_allclose(found, found.T, rtol=1e-12)
    values = np.linalg.eigvalsh(found)
    assert values.min() >= -1e-9 * values.max()
    assert values.max() > 0


BEFORE_WALL = Registered(np.eye(3), ORIGIN - [3.0, 0, 0], 1.0, 0.0, 0.9, np.eye(8), 0)


@pytest.fixture(scope="module")
def wall(scene_of):
    """Return a wall perpendicular to x through the map origin, without thickness."""
    surfels = scene_of(((0, -6, -6), (0, 12, 0), (0, 0, 12))).surfels()
    surfels["thickness_m"] = 0
    return SurfelMap.prepare(ORIGIN, surfels)


@pytest.mark.parametrize(
    ("count", "factor"), [(1, 1.0), (2, 2.0), (8, 8.0), (9, 9.0), (10, 5.0), (12, 3.0), (16, 2.0), (40, 1.25)]
)
def test_few_patches_that_eight_unknowns_were_fitted_to_count_for_more(wall, points_at, count, factor):
    """One point per patch with sigma 0.1 m and error 0.1 m: the scatter of n patches is n times that of one, times n / (n - 8)."""
    k = np.arange(count)
    ahead = rays(0.2 * (k % 8) - 0.7, 0.2 * (k // 8) - 0.5)
    points = points_at(ahead * (2.9 / ahead[:, :1]), sigma=0.0)
    found = score_outer_product(wall, points, BEFORE_WALL, replace(PLAIN, fine=replace(PLAIN.fine, surface=0.1)))
    assert found[0, 0] == pytest.approx(count * factor * (100 * 0.1) ** 2, rel=1e-3)


def test_points_on_their_surfaces_do_not_disagree(scene_of, points_at):
    ground = scene_of(((-6, -6, 0), (12, 0, 0), (0, 12, 0))).surfels()
    cloud = SurfelMap.prepare(ORIGIN, ground)
    xy = np.random.default_rng(1).uniform(-5, 5, (100, 2))
    points = points_at(np.c_[xy, np.full(100, -1.5)])
    on, above = (Registered(np.eye(3), ORIGIN + [0, 0, z], 1.0, 0.0, 0.9, np.eye(8), 0) for z in (1.5, 1.6))
    np.testing.assert_allclose(score_outer_product(cloud, points, on, SETTINGS), np.zeros((8, 8)), atol=1e-12)
    assert score_outer_product(cloud, points, above, SETTINGS)[2, 2] > 1


def test_without_points_there_is_no_scatter(city, pose, points_at):
    found = score_outer_product(city, points_at(np.zeros((0, 3))), registered(pose), SETTINGS)
    np.testing.assert_array_equal(found, np.zeros((8, 8)))


@pytest.fixture(scope="module")
def fan():
    """Return 1200 rays ahead, 30 x 40, in 6 x 8 patches."""
    azimuth, elevation = np.meshgrid(np.linspace(-0.79, 0.79, 40), np.linspace(-0.59, 0.59, 30))
    return rays(azimuth.ravel(), elevation.ravel())


@pytest.fixture(scope="module")
def taken(wall, fan, points_at):
    """Return points of the wall 3 m ahead. Sigma is 1 cm, independent per point or shared by a patch."""

    def made(rng, *, patchwise=False):
        errors = rng.normal(0, 0.01, len(fan))
        errors = errors[patches(fan)] if patchwise else errors
        return points_at(fan * (3.0 / fan[:, :1] + errors[:, None]), sigma=0.01)

    return made


@pytest.fixture(scope="module")
def mean_scatter(wall, taken, fan):
    """Return the mean scatter of many images, without the factor for few patches."""

    def mean(*, patchwise):
        rng = np.random.default_rng(7)
        pictures = [taken(rng, patchwise=patchwise) for _ in range(400)]
        found = np.mean([score_outer_product(wall, each, BEFORE_WALL, PLAIN) for each in pictures], axis=0)
        return found * (1 - 8 / (patches(fan).max() + 1))

    return mean


@pytest.fixture(scope="module")
def information(wall, taken, start_at):
    """Return the information of the same points."""
    start = start_at(np.eye(3), [-3.0, 0, 0])
    align(wall.pieces, taken(np.random.default_rng(8)), start, replace(PLAIN.fine, iterations=1))
    return start["information"][0]


def in_units_of(information, matrix):
    """Scale the unknowns so that the information of each is 1."""
    known = np.diag(information) > 1e-9 * np.diag(information).max()
    size = np.sqrt(np.diag(information)[known])
    assert known.sum() == 4  # of a wall ahead: how far it is, two turns, the scale
    return matrix[np.ix_(known, known)] / np.outer(size, size)


def test_of_independent_points_whose_variances_are_right_scatter_is_the_information(mean_scatter, information):
    """Then the sandwich estimate equals the usual covariance."""
    found, expected = (in_units_of(information, each) for each in (mean_scatter(patchwise=False), information))
    np.testing.assert_allclose(found, expected, atol=0.05)


def test_points_that_err_together_scatter_as_often_more_as_a_patch_has_of_them(mean_scatter, information, fan):
    """A patch has 25 points with a common error. They carry the information of one point."""
    assert len(fan) / (patches(fan).max() + 1) == 25
    found, expected = (in_units_of(information, each) for each in (mean_scatter(patchwise=True), information))
    np.testing.assert_allclose(np.diag(found), 25 * np.diag(expected), rtol=0.15)


@pytest.mark.parametrize(("patchwise", "expected"), [(False, 1.0), (True, 25.0)])
def test_variance_inflation_is_how_many_times_more_the_patches_scatter_than_points_would(
    mean_scatter, information, patchwise, expected
):
    """A wall ahead leaves half of the unknowns unobservable. They do not count."""
    assert variance_inflation(information, mean_scatter(patchwise=patchwise)) == pytest.approx(expected, rel=0.2)


def test_variance_inflation_by_hand_in_any_units():
    """Two unknowns scatter two and four times as much as expected, so the mean is three. The others are unobservable."""
    information = np.diag([4.0, 1e-4, 0, 0, 0, 0, 0, 0])
    scatter = np.diag([8.0, 4e-4, 0, 0, 0, 0, 0, 9.0])
    assert variance_inflation(information, scatter) == pytest.approx(3.0)
    assert variance_inflation(np.zeros((8, 8)), scatter) == 1.0
    assert variance_inflation(information, np.zeros((8, 8))) > 0  # its logarithm is a feature
