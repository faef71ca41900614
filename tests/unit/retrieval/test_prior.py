import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.retrieval.prior import MOST_DOUBT, Prior

DOUBT = np.exp(MOST_DOUBT)
HERE = np.array([100.0, 200.0])


def weight(prior, x=100.0, y=200.0, heading_deg=0.0):
    return float(prior.log_weight(np.array([[x, y]], np.float64), np.array([np.deg2rad(heading_deg)]))[0])


def fit_at(deviations):
    """Return the logarithm of a Gaussian weight with a floor, at most 0."""
    return np.log((np.exp(-0.5 * deviations**2) + DOUBT) / (1 + DOUBT))


def test_a_pose_that_fits_in_every_way_weighs_nothing():
    prior = Prior(position_m=HERE, heading_rad=np.deg2rad(30))
    assert weight(prior, heading_deg=30) == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize(
    ("x", "y", "deviations"), [(105, 200, 1), (95, 200, 1), (100, 210, 2), (103, 204, 1), (115, 200, 3)]
)
def test_a_position_counts_in_its_standard_deviations_whatever_the_heading(x, y, deviations):
    """5 m along each axis; 3 and 4 m are 5 m."""
    prior = Prior(position_m=HERE, position_std_m=5.0)
    for heading_deg in (0, 90, -170):
        assert weight(prior, x, y, heading_deg) == pytest.approx(fit_at(deviations))


@pytest.mark.parametrize(
    ("known_deg", "heading_deg", "deviations"),
    [(0, 10, 1), (0, -20, 2), (175, -175, 1), (-175, 175, 1), (180, -180, 0), (0, 360, 0), (10, 370 - 15, 1.5)],
)
def test_a_heading_counts_the_shorter_way_round_whatever_the_position(known_deg, heading_deg, deviations):
    prior = Prior(heading_rad=float(np.deg2rad(known_deg)), heading_std_rad=float(np.deg2rad(10)))
    for x in (0.0, 1e6):
        assert weight(prior, x, heading_deg=heading_deg) == pytest.approx(fit_at(deviations), abs=1e-9)


def test_position_and_heading_count_together():
    """Three standard deviations of one and four of the other are five."""
    prior = Prior(position_m=HERE, position_std_m=1.0, heading_rad=0.0, heading_std_rad=float(np.deg2rad(5)))
    assert weight(prior, 103, 200, 20) == pytest.approx(fit_at(5.0))


def test_an_empty_prior_prefers_nothing():
    assert weight(Prior(), 1e6, -1e6, 123) == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("far_m", [1e3, 1e6, 1e150])
def test_a_prior_never_rules_a_pose_out(far_m):
    prior = Prior(position_m=HERE, position_std_m=1.0, heading_rad=0.0)
    assert weight(prior, far_m, heading_deg=180) == pytest.approx(MOST_DOUBT, abs=0.01)


near = st.floats(-1e3, 1e3)


@given(near, near, st.floats(0.1, 100), st.floats(1.0, 3.0))
def test_the_further_the_less_and_always_between_the_floor_and_nothing(x, y, std_m, further):
    prior = Prior(position_m=np.zeros(2), position_std_m=std_m)
    one, other = weight(prior, x, y), weight(prior, further * x, further * y)
    assert MOST_DOUBT - 0.01 <= other <= one + 1e-12 <= 1e-9


@given(st.lists(st.tuples(near, near, st.floats(-10, 10)), min_size=1, max_size=8))
def test_many_poses_weigh_what_each_weighs_alone(poses):
    prior = Prior(position_m=np.array([3.0, -4.0]), position_std_m=50.0, heading_rad=1.0, heading_std_rad=0.5)
    x, y, heading = np.array(poses).T
    together = prior.log_weight(np.stack([x, y], axis=1), heading)
    alone = [weight(prior, x_m, y_m, np.rad2deg(turned)) for x_m, y_m, turned in poses]
    np.testing.assert_allclose(together, alone, atol=1e-9)


def test_an_answer_at_the_prior_makes_out_of_map_as_rare_as_a_wrong_prior_and_a_far_one_changes_nothing():
    prior = Prior(position_m=np.array([10.0, 20.0]), position_std_m=3.0)
    assert prior.known_nats(np.array([10.0, 20.0]), 1.0) == pytest.approx(-MOST_DOUBT)
    assert prior.known_nats(np.array([500.0, 20.0]), 1.0) == 0.0


def test_a_heading_prior_does_not_change_the_probability_that_the_place_is_in_the_map():
    assert Prior(heading_rad=0.3).known_nats(np.array([1.0, 2.0]), 0.3) == 0.0
