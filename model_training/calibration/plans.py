"""The cities that confidence is calibrated on: neither trained on, nor watched, nor evaluated."""

from model_training.simulation.hard import HARD, hard_query
from model_training.simulation.plan import QueryPlan, SimulationPlan
from model_training.training.recipe import CALIBRATION_SEEDS

CITIES = 3
SEQUENCE = 5
#: Seed of the street of blocks that repeat, among the calibration's.
_REPEATING = 50
BOTH = ("precise", "stereo")


def calibration_plan(index: int, *, queries: int = 350, hard: int = 40, sequences: int = 80) -> SimulationPlan:
    """One of ``CITIES``: a clear day's drive and every hard condition, with both depth presets; the last has sequences too.

    Args:
        index: of the city.
        queries: of the clear day's drive.
        hard: of each hard condition.
        sequences: of ``SEQUENCE`` frames, in the last city.
    """
    drives = [QueryPlan(name="clear", traversal=1, count=queries, depths=BOTH)]
    drives += [hard_query(name, traversal=2 + k, count=hard, depths=BOTH) for k, name in enumerate(HARD)]
    if index == CITIES - 1:
        traversal = 2 + len(HARD)
        drives.append(
            QueryPlan(
                name="sequences", traversal=traversal, count=sequences, depths=BOTH, sequence=SEQUENCE, step_m=3.0
            )
        )
    return SimulationPlan(name=f"calibration-{index + 1}", seed=CALIBRATION_SEEDS[index], queries=tuple(drives))


def repeating_plan(*, singles: int = 150, sequences: int = 100) -> SimulationPlan:
    """A street of blocks that are all alike but for a landmark every few of them: what is there cannot always be told."""
    drives = (
        QueryPlan(name="clear", traversal=1, count=singles, depths=BOTH, aside_m=1.5),
        QueryPlan(
            name="sequences", traversal=2, count=sequences, depths=BOTH, aside_m=1.5, sequence=SEQUENCE, step_m=3.0
        ),
    )
    return SimulationPlan(
        name="calibration-repeating", city="repeating", seed=CALIBRATION_SEEDS[_REPEATING], queries=drives
    )
