import pytest

pytest.importorskip("torch", reason="needs the extra `training`")

from model_training.calibration.families import FAMILIES, FAMILY_CITIES, family_plan  # after the skip
from model_training.calibration.plans import (
    CITIES,
    SEQUENCE,
    calibration_plan,
    repeating_plan,
)
from model_training.simulation.hard import HARD
from model_training.training.recipe import CALIBRATION_SEEDS


def test_calibration_cities_have_seeds_of_their_own_among_those_kept_for_them():
    seeds = [calibration_plan(index).seed for index in range(CITIES)] + [repeating_plan().seed]
    seeds += [family_plan(family, index).seed for family in FAMILIES for index in range(FAMILY_CITIES)]
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


@pytest.mark.parametrize("plan", [calibration_plan(CITIES - 1, sequences=4), repeating_plan(sequences=4)])
def test_the_last_city_and_the_repeating_blocks_are_asked_in_sequences_too(plan):
    last = plan.queries[-1]
    assert (last.name, last.count, last.sequence, last.depths) == ("sequences", 4, SEQUENCE, ("precise", "stereo"))
    assert last.traversal not in {query.traversal for query in plan.queries[:-1]}
    assert all(query.sequence is None for query in plan.queries[:-1])
