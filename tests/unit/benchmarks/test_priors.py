import numpy as np
import pytest

from benchmarks.priors import PRIORS, STD_M, at_a_place, next_block
from model_training.simulation.repeating import BLOCK_M


def drawn(kind, count=400):
    T = np.eye(4)
    T[:2, 3] = 30.0, -20.0
    found = [PRIORS[kind](T, np.random.default_rng([1, k])) for k in range(count)]
    assert {prior.position_std_m for prior in found} == {STD_M}
    return np.array([prior.position_m for prior in found]) - T[:2, 3]


def test_a_right_prior_has_an_error_of_its_standard_deviation():
    assert drawn("right").std(axis=0) == pytest.approx(STD_M, rel=0.15)
    assert np.abs(drawn("right").mean(axis=0)).max() < 1


@pytest.mark.parametrize(("kind", "least", "most"), [("aside", 10, 25), ("elsewhere", 60, 120)])
def test_a_wrong_prior_has_an_error_beyond_its_standard_deviation(kind, least, most):
    away = np.hypot(*drawn(kind).T)
    assert least <= away.min() < away.max() <= most
    assert np.abs(drawn(kind).mean(axis=0)).max() < 0.15 * most  # in any direction


def test_the_next_block_is_a_block_further():
    T = np.eye(4)
    position_m = next_block(T, np.random.default_rng(0)).position_m
    assert position_m is not None
    np.testing.assert_allclose(position_m, [BLOCK_M, 0.0])


def test_a_robot_outside_of_the_map_claims_to_be_near_one_of_its_places():
    places = np.array([[100.0, 0.0], [0.0, 100.0]])
    found = [at_a_place(places)(np.eye(4), np.random.default_rng(k)).position_m for k in range(200)]
    away = np.array([np.linalg.norm(places - each, axis=1) for each in found])
    assert away.min(axis=1).max() < 5 * STD_M
    assert 0.4 < (away[:, 0] < away[:, 1]).mean() < 0.6
