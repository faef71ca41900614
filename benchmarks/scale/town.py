"""The town: 20 km of streets in a square kilometre, built in tiles."""

from benchmarks.plans import BOTH
from model_training.simulation.plan import QueryPlan, SimulationPlan
from model_training.training.recipe import EVALUATION_SEEDS

#: Extent of the town, m; queries with each depth camera; sequences of frames.
TOWN_M, QUERIES, SEQUENCES, FRAMES = (1000.0, 1000.0), 500, 100, 5


def town_plan() -> SimulationPlan:
    """Plan the town: a survey with 32 beams, another traversal with single frames, and one with sequences of five frames."""
    queries = (
        QueryPlan(name="drive1", traversal=1, count=QUERIES, depths=BOTH),
        QueryPlan(name="sequence5", traversal=2, count=SEQUENCES, sequence=FRAMES, step_m=2.0, depths=("stereo",)),
    )
    return SimulationPlan(name="town", seed=EVALUATION_SEEDS[50], size_m=TOWN_M, queries=queries)
