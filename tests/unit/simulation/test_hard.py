import pytest

from model_training.simulation.conditions import CONDITIONS
from model_training.simulation.hard import HARD, WEATHER_AND_LIGHT, hard_query
from model_training.simulation.plan import QueryPlan


@pytest.mark.parametrize("name", HARD)
def test_every_hard_condition_is_a_drive_that_can_be_simulated(plan_of, name):
    query = hard_query(name, traversal=7, count=3, depths=("precise", "stereo"))
    plan_of(queries=(query,)).checked()
    assert (query.name, query.traversal, query.count, query.depths) == (name, 7, 3, ("precise", "stereo"))


@pytest.mark.parametrize("name", HARD)
def test_each_differs_from_a_clear_days_drive_in_one_thing(name):
    clear, hard = QueryPlan(name=name, traversal=1, count=9), hard_query(name, traversal=1, count=9)
    differing = [field for field in QueryPlan.model_fields if getattr(hard, field) != getattr(clear, field)]
    assert len(differing) == 1
    assert (differing == ["condition"]) == (name in WEATHER_AND_LIGHT)


def test_weather_and_light_are_conditions_and_every_name_is_there_once():
    assert set(WEATHER_AND_LIGHT) <= set(CONDITIONS)
    assert len(set(HARD)) == len(HARD) == 12


def test_a_name_that_is_none_is_an_error():
    with pytest.raises(KeyError, match="hail"):
        hard_query("hail", traversal=1, count=1)
