"""The cities that confidence is calibrated on: neither trained on, nor watched, nor evaluated."""

from model_training.simulation.hard import HARD, hard_query
from model_training.simulation.plan import QueryPlan, SimulationPlan
from model_training.training.recipe import CALIBRATION_SEEDS

CITIES = 2
BOTH = ("precise", "stereo")


def calibration_plan(index: int, *, queries: int = 350, hard: int = 40) -> SimulationPlan:
    """One of ``CITIES``: a clear day's drive and every hard condition, with both depth presets.

    Args:
        index: of the city.
        queries: of the clear day's drive.
        hard: of each hard condition.
    """
    drives = [QueryPlan(name="clear", traversal=1, count=queries, depths=BOTH)]
    drives += [hard_query(name, traversal=2 + k, count=hard, depths=BOTH) for k, name in enumerate(HARD)]
    return SimulationPlan(name=f"calibration-{index + 1}", seed=CALIBRATION_SEEDS[index], queries=tuple(drives))
