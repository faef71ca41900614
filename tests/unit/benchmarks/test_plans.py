import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the extra `training`")

from benchmarks.plans import (  # after the skip
    HEIGHTS_M,
    SEQUENCE,
    SPARSE_M,
    hard_plan,
    height_plan,
    large_plan,
    lidar_16_plan,
    lidar_os0_plan,
    more_plan,
    paper_plan,
    repeating_plan,
    unseen_plan,
    vehicle_ahead_plan,
)
from benchmarks.runs import pooled
from model_training.simulation.drives import driven
from model_training.simulation.hard import HARD
from model_training.simulation.lidar import LIDARS
from model_training.simulation.simulate import _city
from model_training.training.recipe import EVALUATION_SEEDS

OWN = (
    [unseen_plan(k) for k in range(3)]
    + [large_plan(k) for k in range(3)]
    + [more_plan(k) for k in range(3)]
    + [hard_plan(), lidar_16_plan(), lidar_os0_plan(), repeating_plan(), vehicle_ahead_plan()]
    + [height_plan(height_m) for height_m in HEIGHTS_M]
)


@pytest.mark.parametrize("plan", [*OWN, paper_plan()], ids=lambda plan: plan.name)
def test_every_plan_can_be_simulated_and_every_drive_is_one_of_its_own(plan):
    plan.checked()
    drives = [query.traversal for query in plan.queries]
    assert len(set(drives)) == len(drives)


def test_cities_have_their_own_seeds_and_distinct_names():
    assert {plan.seed for plan in OWN} <= set(EVALUATION_SEEDS)
    assert len({plan.seed for plan in OWN[:3]}) == 3
    names = [plan.name for plan in OWN]
    assert len(set(names)) == len(names)


def test_a_thousand_queries_of_each_unseen_city_and_both_plans_are_of_one_city():
    first, more = ([plan(k) for k in range(3)] for plan in (unseen_plan, more_plan))
    assert sum(plan.queries[0].count for plan in first) == 1000
    assert [a.queries[0].count + b.queries[0].count for a, b in zip(first, more, strict=True)] == [1000] * 3
    for one, other in zip(first, more, strict=True):
        assert one.model_dump(exclude={"name", "queries"}) == other.model_dump(exclude={"name", "queries"})
        assert not {query.traversal for query in one.queries} & {query.traversal for query in other.queries}


def test_large_cities_get_the_same_queries_and_differ_in_size_only():
    for k in range(3):
        small, large = unseen_plan(k), large_plan(k)
        assert (small.size_m, large.size_m) == ((300.0, 400.0), (600.0, 400.0))
        assert large.model_dump(exclude={"name", "size_m"}) == small.model_dump(exclude={"name", "size_m"})


def test_every_hard_condition_stands_beside_a_clear_day():
    plan = hard_plan()
    assert [query.name for query in plan.queries] == ["clear", *HARD, "depth_15m_sequence5"]
    assert {query.count for query in plan.queries[:-1]} == {500}
    assert plan.queries[-1].sequence == SEQUENCE
    assert lidar_16_plan().queries[0] == plan.queries[0]


def test_the_survey_of_the_os0_differs_from_the_sparse_one_by_its_lidar_only():
    """Its map answers the queries of ``hard_plan``, so it has the same city and none of its own."""
    plan, other = lidar_os0_plan(), hard_plan()
    assert (plan.lidar, plan.spacing_m, plan.queries) == ("os0_128", SPARSE_M, ())
    changed = {"name", "lidar", "spacing_m", "queries"}
    assert plan.model_dump(exclude=changed) == other.model_dump(exclude=changed)
    model = LIDARS[plan.lidar]
    rays = model.rays().reshape(model.channels, model.columns, 3)[:, 0]
    elevation_deg = np.rad2deg(np.arcsin(rays[:, 2]))
    np.testing.assert_allclose(np.diff(elevation_deg), -90 / 127, atol=1e-4)
    np.testing.assert_allclose(elevation_deg[[0, -1]], [45.0, -45.0], atol=1e-4)


def test_a_vehicle_is_ahead_of_every_query_and_of_the_whole_survey():
    """The map of the unseen city answers its queries too, so both have the same city."""
    plan, other = vehicle_ahead_plan(), unseen_plan(0)
    assert plan.survey_parameters.followed == 1.0
    assert {query.followed for query in plan.queries} == {1.0}
    changed = {"name", "survey_parameters", "queries"}
    assert plan.model_dump(exclude=changed) == other.model_dump(exclude=changed)


def test_the_repeating_street_has_room_for_its_sequences():
    plan = repeating_plan()
    assert {query.sequence for query in plan.queries} == {SEQUENCE}
    assert len({query.traversal for query in plan.queries}) == len(plan.queries)  # other people on every drive
    assert len(driven(_city(plan), plan, plan.spacing_m)) > 5 * plan.queries[0].count


def test_shares_of_several_cities_are_pooled_by_their_queries():
    parts = [
        {"queries": 100, "street_queries": 10, "localized": 0.5, "street_accuracy": 1.0},
        {"queries": 300, "street_queries": 30, "localized": 0.9, "street_accuracy": 0.5},
    ]
    value, count, (low, high) = pooled(parts, "localized")
    assert (value, count) == (0.8, 400)
    assert low < 0.8 < high
    assert pooled(parts, "street_accuracy")[:2] == (0.625, 40)
