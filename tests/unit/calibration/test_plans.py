import pytest

pytest.importorskip("torch", reason="needs the extra `training`")

from model_training.calibration.plans import CITIES, calibration_plan  # after the skip
from model_training.simulation.hard import HARD
from model_training.training.recipe import CALIBRATION_SEEDS


def test_calibration_cities_have_seeds_of_their_own_among_those_kept_for_them():
    seeds = [calibration_plan(index).seed for index in range(CITIES)]
    assert set(seeds) <= set(CALIBRATION_SEEDS)
    assert len(set(seeds)) == len(seeds) > 1


def test_every_hard_condition_is_asked_with_both_presets_on_a_drive_of_its_own():
    plan = calibration_plan(0, queries=7, hard=3)
    assert [query.name for query in plan.queries] == ["clear", *HARD]
    assert {query.depths for query in plan.queries} == {("precise", "stereo")}
    assert [query.count for query in plan.queries] == [7, *[3] * len(HARD)]
    drives = [query.traversal for query in plan.queries]
    assert len(set(drives)) == len(drives)
    assert 0 not in drives  # the survey's own
