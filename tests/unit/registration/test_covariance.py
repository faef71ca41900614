from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.geometry.rigid import rotation_z
from service.registration import covariance
from service.registration.covariance import CovarianceModel, Stability
from service.registration.surfel_map import SurfelMap

PRIOR_SIGMA = np.array([30.0, 30.0, 0.3, *np.deg2rad([2.0, 2.0, 10.0])])
PRIOR = np.diag([*PRIOR_SIGMA, 0.01, 0.3]) ** 2
FLOOR = np.array([0.02, 0.02, 0.01, *np.deg2rad([0.02, 0.03, 0.05])])
NONE = np.zeros((8, 8))
#: Of pictures whose deviations are twice those of independent points, and three times those of patches.
NOISE = 1e-3
MODEL = CovarianceModel(
    independent=2.0,
    independent_power=0.5,
    shared=3.0,
    axes=(1.0,) * 6,
    axes_power=(0.0,) * 6,
    floor=(0.02, 0.02, 0.01, 0.02, 0.03, 0.05),
)


def covariance_of(information, scatter, noise, model=MODEL, heading_rad=0.0):
    return covariance.covariance_of(information, scatter, noise, heading_rad, model)


@pytest.fixture(autouse=True)
def counted(monkeypatch):
    """Constants that these tests assume."""
    numbers = {
        "AT_NOISE": NOISE,
        "LEAST": NOISE / 16,
        "MOST": 16 * NOISE,
    }
    for name, value in numbers.items():
        monkeypatch.setattr(covariance, name, value)


def random_information(seed, rows, scale):
    """Return the information of several points with random gradients."""
    gradients = np.random.default_rng(seed).normal(size=(rows, 8))
    return scale * gradients.T @ gradients


noises = st.floats(0, 0.1)
informations = st.builds(
    random_information, st.integers(0, 10**6), st.integers(0, 20), st.sampled_from([1.0, 1e3, 1e6])
)


def without_floor(information, scatter, noise=NOISE, model=MODEL):
    return covariance_of(information, scatter, noise, model) - np.diag(FLOOR**2)


@pytest.mark.parametrize(
    ("noise", "independent"), [(1e-3, 2.0), (16e-3, 8.0), (0.5, 8.0), (1e-3 / 16, 0.5), (1e-5, 0.5), (0.0, 0.5)]
)
def test_deviations_of_points_are_stretched_by_a_factor_of_the_noise_within_limits_and_of_patches_by_one(
    noise, independent
):
    """1 cm from the information of the points and 2 cm from the scatter of the patches add in variance, and so does the floor.

    The first part grows with the square root of the noise: factor 2 at 0.001, limited to 1/16 and 16.
    """
    found = covariance_of(1e4 * np.eye(8), 4e4 * np.eye(8), noise)
    expected = (independent * 0.01) ** 2 + (3.0 * 0.02) ** 2 + FLOOR[:2] ** 2
    np.testing.assert_allclose(np.diag(found)[:2], expected, rtol=1e-3)


@given(st.integers(0, 10**6), st.sampled_from([1.0, 1e3, 1e6]))
def test_without_scatter_the_covariance_is_that_of_independent_points(seed, scale):
    information = random_information(seed, 20, scale)
    expected = np.linalg.inv(information / 4 + np.linalg.inv(PRIOR))[:6, :6] + np.diag(FLOOR**2)
    np.testing.assert_allclose(covariance_of(information, NONE, NOISE), expected, rtol=1e-6, atol=1e-12)


@given(st.integers(0, 10**6))
def test_where_scatter_is_the_information_the_sandwich_is_the_usual_covariance(seed):
    """The factor is 9 for patches and 4 for points. With so many points the priors have no effect."""
    information = random_information(seed, 40, 1e9)
    inverse = np.linalg.inv(information)[:6, :6]
    shared = covariance_of(information, information, NOISE) - covariance_of(information, NONE, NOISE)
    np.testing.assert_allclose(shared, 9 * inverse, rtol=1e-3, atol=1e-3 * inverse.max())
    np.testing.assert_allclose(
        without_floor(information, information), 13 * inverse, rtol=1e-3, atol=1e-3 * inverse.max()
    )


def test_patches_that_disagree_in_one_way_make_that_way_alone_uncertain():
    """Gradients of 100 along x and 200 along yaw: 1 cm and 0.01 rad per hundred, times three, fully correlated."""
    pull = np.array([100.0, 0, 0, 0, 0, -200.0, 0, 0])
    shared = covariance_of(1e4 * np.eye(8), np.outer(pull, pull), NOISE) - covariance_of(1e4 * np.eye(8), NONE, NOISE)
    expected = np.zeros((6, 6))
    expected[np.ix_([0, 5], [0, 5])] = 9e-4 * np.array([[1.0, -2.0], [-2.0, 4.0]])
    np.testing.assert_allclose(shared, expected, rtol=1e-2, atol=1e-9)


@given(informations, informations, noises)
def test_a_covariance_is_symmetric_and_positive_definite(information, scatter, noise):
    found = covariance_of(information, scatter, noise)
    np.testing.assert_array_equal(found, found.T)
    assert np.linalg.eigvalsh(found - 0.99 * np.diag(FLOOR**2)).min() > -1e-9 * found.max()
    assert np.linalg.eigvalsh(found).min() > 0


@given(informations, informations, noises, noises)
def test_noise_never_makes_a_pose_better_known(information, scatter, one, other):
    less, more = (covariance_of(information, scatter, noise) for noise in sorted((one, other)))
    assert np.linalg.eigvalsh(more - less).min() > -1e-9 * more.max()


@given(informations, informations, informations, noises)
def test_more_disagreement_means_more_variance_in_every_direction(information, scatter, more, noise):
    gained = covariance_of(information, scatter + more, noise) - covariance_of(information, scatter, noise)
    assert np.linalg.eigvalsh(gained).min() > -1e-9 * max(1.0, gained.max())


@given(informations, informations, noises)
def test_more_information_of_patches_that_agree_means_less_variance_in_every_direction(information, more, noise):
    gained = covariance_of(information, NONE, noise) - covariance_of(information + more, NONE, noise)
    assert np.linalg.eigvalsh(gained).min() > -1e-6 * max(1.0, gained.max())  # a rank of one, a million times the prior


@pytest.mark.parametrize("patches", [0.0, 1.0, 30.0])
def test_more_information_about_every_unknown_means_strictly_less_variance(patches):
    """The scatter grows by the same factor, as with more patches."""
    information = random_information(1, 20, 1e3)
    variances = [np.diag(covariance_of(k * information, k * patches * information, NOISE)) for k in (1, 4, 16)]
    assert (variances[0] > variances[1]).all()
    assert (variances[1] > variances[2]).all()


@pytest.mark.parametrize("noise", [0.0, NOISE, 1.0])
def test_without_information_the_priors_remain(noise):
    expected = np.diag(PRIOR_SIGMA**2 + FLOOR**2)
    np.testing.assert_allclose(covariance_of(NONE, NONE, noise), expected, rtol=1e-9)


@pytest.mark.parametrize("scatter", [0.0, 1e15])
def test_endless_information_leaves_the_floor_of_each_axis(scatter):
    found = covariance_of(1e15 * np.eye(8), scatter * np.eye(8), NOISE)
    np.testing.assert_allclose(found, np.diag(FLOOR**2), rtol=1e-3, atol=1e-12)


@pytest.mark.parametrize(
    ("noise", "factors"),
    [(NOISE, [1, 1, 1, 0.5, 0.5, 1]), (16 * NOISE, [1, 1, 0.25, 0.5, 0.5, 2]), (NOISE / 16, [1, 1, 4, 0.5, 0.5, 0.5])],
)
def test_axes_are_stretched_by_factors_of_their_own_but_not_their_floor(noise, factors):
    """The factors stretch standard deviations, so correlations stay equal. The floor stays equal too."""
    information, scatter = random_information(3, 30, 1e3), random_information(4, 30, 1e4)
    plain = without_floor(information, scatter, noise)
    stretched = replace(MODEL, axes=(1.0, 1.0, 1.0, 0.5, 0.5, 1.0), axes_power=(0.0, 0.0, -0.5, 0.0, 0.0, 0.25))
    found = without_floor(information, scatter, noise, stretched)
    np.testing.assert_allclose(found, plain * np.outer(factors, factors), rtol=1e-9, atol=1e-15)
    assert np.abs(plain[0, 3:]).min() > 0  # or what is said of correlations would be of nothing


@given(st.integers(0, 10**6), st.floats(-7, 7))
def test_along_and_across_the_view_are_stretched_wherever_it_points(seed, heading):
    """If everything known rotates with the view, the covariance rotates too. Its floor is equal in x and y."""
    known, patches = random_information(seed, 30, 1e3), random_information(seed + 1, 30, 1e4)
    model = replace(MODEL, axes=(2.0, 0.5, 1.0, 0.7, 1.4, 1.0))
    turn = np.eye(8)
    turn[:6, :6] = np.kron(np.eye(2), rotation_z(heading))
    ahead = covariance_of(known, patches, NOISE, model) - np.diag(FLOOR**2)
    turned = covariance_of(turn @ known @ turn.T, turn @ patches @ turn.T, NOISE, model, heading) - np.diag(FLOOR**2)
    six = turn[:6, :6]
    np.testing.assert_allclose(turned, six @ ahead @ six.T, rtol=1e-4, atol=1e-6 * np.abs(ahead).max())


@pytest.mark.parametrize("disagree", [0.0, 1.0])
def test_an_unknown_scale_costs_certainty(disagree):
    """All points constrain only the sum of x and log scale. So x has at least the uncertainty of the scale, 0.01."""
    information = np.zeros((8, 8))
    information[np.ix_([0, 6], [0, 6])] = 1e8
    x = without_floor(information, disagree * information)[0, 0]
    assert np.sqrt(x) == pytest.approx(0.01, rel=0.01)


@pytest.mark.parametrize("disagree", [0.0, 3.0])
@pytest.mark.parametrize("heading_deg", [0, 30, 120])
def test_in_a_corridor_the_position_along_it_is_the_least_known(scene_of, start_at, settle, heading_deg, disagree):
    """Holds for consistent and for inconsistent walls."""
    R = rotation_z(np.deg2rad(heading_deg))
    flat = [
        ((-30, -4, 0), (60, 0, 0), (0, 8, 0)),
        ((-30, -4, 0), (60, 0, 0), (0, 0, 6)),
        ((-30, 4, 0), (60, 0, 0), (0, 0, 6)),
    ]
    corridor = scene_of(*(tuple(R @ np.array(each, float) for each in rectangle) for rectangle in flat))
    surfels = corridor.surfels(0.5)
    cloud = SurfelMap.prepare(np.zeros(3), surfels)
    camera = np.array([0, 0, 1.5])
    points = corridor.points(R, camera)
    state = settle(cloud, points.subset(np.flatnonzero(np.linalg.norm(points.xyz, axis=1) < 25)), start_at(R, camera))
    information = state["information"][0]
    found = covariance_of(information, disagree * information, NOISE)
    variances, axes = np.linalg.eigh(found[:3, :3])
    assert abs(axes[:, 2] @ R[:, 0]) > 0.999
    assert variances[2] > 1000 * variances[1]
    assert np.sqrt(variances[1]) < 0.05


def test_a_survey_with_usual_errors_adds_nothing():
    """The floors include this error. A map without a stated accuracy counts as usual."""
    for usual in ((None, None), (0.03, 0.05), (0.0, 0.0)):
        np.testing.assert_array_equal(covariance.survey_covariance(*usual), np.zeros((6, 6)))


def test_a_poor_survey_adds_the_excess_of_its_variance():
    """0.05^2 - 0.03^2 = 0.04^2 m^2, and 0.13^2 - 0.05^2 = 0.12^2 square degrees."""
    found = covariance.survey_covariance(0.05, 0.13)
    np.testing.assert_allclose(np.sqrt(np.diag(found)), [0.04] * 3 + [np.deg2rad(0.12)] * 3)
    np.testing.assert_array_equal(found, np.diag(np.diag(found)))


@pytest.mark.parametrize(
    ("height_m", "baseline_m", "tilt_deg"),
    [(1.0, 1.0, 0.065), (1.65, 0.55, 0.195), (0.9, 0.06, 0.975), (4.0, 0.01, 3.0)],
)
def test_the_rectification_of_a_stereo_pair_tilts_the_pose(height_m, baseline_m, tilt_deg):
    """0.065 degrees times height over baseline, at most 3 degrees."""
    found = covariance.rectification_covariance(height_m, baseline_m)
    tilt = np.deg2rad(tilt_deg)
    np.testing.assert_allclose(np.sqrt(np.diag(found)), [0, 0, 0, tilt, tilt, 0])


def test_the_relative_poses_of_several_frames_turn_the_answer():
    """0.17 degrees are 0.002967 rad about each axis, for any number of frames but one."""
    np.testing.assert_allclose(
        covariance.relative_pose_covariance(5), np.diag([0, 0, 0, *[0.002967**2] * 3]), rtol=1e-3
    )
    np.testing.assert_array_equal(covariance.relative_pose_covariance(2), covariance.relative_pose_covariance(4))
    np.testing.assert_array_equal(covariance.relative_pose_covariance(1), np.zeros((6, 6)))


STABLE = Stability(restarts=np.zeros((6, 6)), shift=np.zeros(6), mapped_inliers=1.0, along_residual=0.0)


def of_rays(stability, information=None, scatter=None, **factors):
    """Return a covariance without its floor; the information is 1e4 and the scatter as large, unless given."""
    information = 1e4 * np.eye(8) if information is None else information
    model = replace(MODEL, **factors)
    scatter = information if scatter is None else scatter
    return covariance.covariance_of(information, scatter, NOISE, 0.0, model, stability) - np.diag(FLOOR**2)


def test_restarts_and_shift_are_added_as_outer_products():
    """The spread counts with the square of its factor 2, the shift with that of 3."""
    spread, shift = np.diag([0.04, 0.01, 0, 0, 0, 1e-4]), np.array([0.1, 0, 0.2, 0, 0, 0.01])
    plain = of_rays(STABLE, restarts=2.0, shift=3.0)
    with_both = of_rays(replace(STABLE, restarts=spread, shift=shift), restarts=2.0, shift=3.0)
    np.testing.assert_allclose(with_both - plain, 4 * spread + 9 * np.outer(shift, shift), atol=1e-12)


@pytest.mark.parametrize(
    ("changes", "scatter", "exponent"),
    [
        ({"mapped_inliers": 0.7}, 1.0, 0.5 * 0.2),
        ({"mapped_inliers": 0.9}, 1.0, 0.0),
        ({"along_residual": 2.0}, 1.0, -0.25 * 2.0 - 0.5 * 0.1),
        ({"mapped_inliers": 0.9}, 16.0, 0.3 * np.log(16)),
        ({"mapped_inliers": -9.0}, 1.0, 1.5),
        ({"along_residual": 99.0}, 1.0, -1.5),
    ],
)
def test_a_misfit_scales_everything_above_the_floor(changes, scatter, exponent):
    """Factors 0.3 (inflation), 0.5 (points that are no inliers) and -0.25 (along residual); usually a tenth are no inliers."""
    spread = np.diag([0.04, 0.01, 0, 0, 0, 1e-4])
    stability, information = replace(STABLE, restarts=spread, **changes), 1e4 * np.eye(8)
    known = {"information": information, "scatter": scatter * information, "restarts": 1.0}
    found = of_rays(stability, misfit=(0.3, 0.5, -0.25), usual=(0.0, 0.1, 0.0), **known)
    np.testing.assert_allclose(found, np.exp(2 * exponent) * of_rays(stability, **known), rtol=1e-6)


def test_without_the_independent_part_only_the_scatter_counts():
    information, scatter = 1e4 * np.eye(8), np.diag([4e4, 0, 0, 0, 0, 0, 0, 0])
    found = of_rays(STABLE, information, scatter, independent=0.0)
    np.testing.assert_allclose(found, np.diag([9 * 4e-4, 0, 0, 0, 0, 0]), rtol=1e-3, atol=1e-12)


@given(
    informations, informations, st.lists(st.floats(-50, 50), min_size=6, max_size=6), st.floats(-9, 1), st.floats(0, 99)
)
def test_a_covariance_of_rays_is_finite_and_positive(information, scatter, shift, inliers, along):
    stability = Stability(
        restarts=np.outer(shift, shift), shift=np.array(shift), mapped_inliers=inliers, along_residual=along
    )
    found = covariance.covariance_of(information, scatter, NOISE, 1.0, covariance.OF_RAYS, stability)
    assert np.isfinite(found).all()
    assert np.linalg.eigvalsh(found).min() > 0
