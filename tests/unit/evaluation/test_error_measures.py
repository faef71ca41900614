import numpy as np
import pytest

from model_training.datasets.dataset import write_tum
from model_training.evaluation.error_measures import (
    distance_errors,
    error_rate,
    heading_errors_deg,
    mean_error_distance,
    mean_squared_error,
    root_mean_squared_error,
    wilson_interval,
)
from service.geometry.rigid import rotation_z, transform_from

DISTANCES = np.array([0.0, 1.0, 2.0, 5.0])


def test_error_distance_is_pythagoras():  # eq. 14
    found = distance_errors(np.array([[3.0, 4.0], [1.0, 1.0]]), np.array([[0.0, 0.0], [1.0, -1.5]]))
    np.testing.assert_allclose(found, [5.0, 2.5])


def test_error_rate_is_the_share_that_is_wrong():  # eq. 15
    assert error_rate(np.array([True, True, True, False])) == 0.25


def test_mean_error_distance_by_hand():  # eq. 16
    assert mean_error_distance(DISTANCES) == 2.0


def test_mean_squared_error_by_hand():  # eq. 17, 18
    assert mean_squared_error(DISTANCES) == 7.5


def test_root_mean_squared_error_by_hand():
    assert root_mean_squared_error(DISTANCES) == pytest.approx(2.7386127875)


@pytest.mark.parametrize(
    ("predicted_deg", "true_deg", "error_deg"),
    [(10, 350, 20), (-179, 179, 2), (0, 180, 180), (725, 5, 0), (90, 91.5, 1.5)],
)
def test_heading_errors_go_the_short_way_round(predicted_deg, true_deg, error_deg):
    found = heading_errors_deg(np.deg2rad([float(predicted_deg)]), np.deg2rad([float(true_deg)]))
    np.testing.assert_allclose(found, [error_deg], atol=1e-9)


@pytest.mark.parametrize(
    ("successes", "count", "low", "high"),
    [(8, 10, 0.4902, 0.9433), (0, 10, 0.0, 0.2775), (10, 10, 0.7225, 1.0), (81, 263, 0.2553, 0.3662), (0, 0, 0.0, 1.0)],
)
def test_wilson_intervals_are_the_published_ones(successes, count, low, high):
    """81 of 263: Newcombe, Statistics in Medicine 17 (1998), table I, method 3."""
    assert wilson_interval(successes, count) == pytest.approx((low, high), abs=1e-4)


def test_evo_finds_the_same_rms_in_the_plane(evo_ape, tmp_path):
    rng = np.random.default_rng(0)
    true = np.stack(
        [transform_from(rotation_z(a), np.array([*rng.uniform(-200, 200, 2), 0.0])) for a in rng.uniform(-3, 3, 40)]
    )
    answered = true.copy()
    answered[:, :2, 3] += rng.normal(0, 0.7, (40, 2))
    for name, poses in (("true.txt", true), ("answered.txt", answered)):
        write_tum(tmp_path / name, np.arange(40.0), poses)
    rms = evo_ape(tmp_path / "true.txt", tmp_path / "answered.txt").rmse_m
    distances = distance_errors(answered[:, :2, 3], true[:, :2, 3])
    assert root_mean_squared_error(distances) == pytest.approx(rms, abs=1e-5)
