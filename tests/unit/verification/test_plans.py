import pytest

from model_training.training.recipe import (
    CALIBRATION_SEEDS,
    EVALUATION_SEEDS,
    TRAINING_SEEDS,
    VALIDATION_SEEDS,
    more_street_plans,
    stock_plans,
    street_plans,
)
from model_training.verification.plans import MOST_CITIES, verification_plan

PLANS = [verification_plan(k) for k in range(MOST_CITIES)]


def test_no_other_use_has_the_seeds_of_the_verifier():
    """Training, validation, calibration and evaluation, and the cities of the encoder."""
    seeds = {plan.seed for plan in PLANS}
    assert len(seeds) == MOST_CITIES
    assert seeds <= set(TRAINING_SEEDS)
    for others in (VALIDATION_SEEDS, CALIBRATION_SEEDS, EVALUATION_SEEDS):
        assert not seeds & set(others)
    assert not seeds & {plan.seed for plan in (*street_plans(), *more_street_plans(), *stock_plans(26))}


def test_a_plan_is_the_same_every_time():
    assert verification_plan(7) == verification_plan(7)


def test_plans_can_be_simulated():
    for plan in PLANS:
        plan.checked()


def test_the_rigs_cover_all_kinds_of_depth_and_all_heights():
    depths = {plan.queries[0].depths[0] for plan in PLANS}
    assert depths == {"sgbm", "sgbm3way", "bm", "precise", "stereo"}
    heights = [plan.camera_height_m for plan in PLANS]
    assert 0.25 <= min(heights) < 0.35 < 2.8 < max(heights) <= 3.4
    fields = [plan.camera.horizontal_deg for plan in PLANS]
    assert min(fields) < 60 < 100 < max(fields)
    assert len({plan.lidar for plan in PLANS}) >= 7
    assert {plan.spacing_m for plan in PLANS} == {1, 1.5, 2, 2.5, 3.5, 5}


def test_every_second_traversal_is_in_hard_light():
    for plan in PLANS:
        assert [query.condition for query in plan.queries] == ["clear", "hard_light"] * 2


@pytest.mark.parametrize("index", [-1, MOST_CITIES])
def test_other_indices_are_refused(index):
    with pytest.raises(ValueError, match=f"index: {index} is not between 0 and {MOST_CITIES - 1}"):
        verification_plan(index)
