"""Plan the calibration cities: they serve neither training nor validation nor evaluation."""

from model_training.simulation.hard import HARD, hard_query
from model_training.simulation.plan import QueryPlan, SimulationPlan
from model_training.training.recipe import CALIBRATION_SEEDS

#: Number of cities with modelled depth errors.
CITIES = 2
#: Number of frames in a sequence.
SEQUENCE = 5
#: Index of the seed of the street with repeating blocks in ``CALIBRATION_SEEDS``.
_REPEATING = 50
#: The depth presets.
BOTH = ("precise", "stereo")


def calibration_plan(index: int, *, queries: int = 200, hard: int = 25, sequences: int = 60) -> SimulationPlan:
    """Plan one of the ``CITIES``: a traversal on a clear day and one in each hard condition, with both depth presets.

    The last city has sequences too.

    Args:
        index: index of the city, from 0.
        queries: number of queries on the clear day.
        hard: number of queries in each hard condition.
        sequences: number of sequences of ``SEQUENCE`` frames in the last city.
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


def repeating_plan(*, singles: int = 120, sequences: int = 80) -> SimulationPlan:
    """Plan a street of equal blocks with a landmark every few blocks. The place is often ambiguous there.

    Args:
        singles: number of single queries.
        sequences: number of sequences of ``SEQUENCE`` frames.
    """
    drives = (
        QueryPlan(name="clear", traversal=1, count=singles, depths=BOTH, aside_m=1.5),
        QueryPlan(
            name="sequences", traversal=2, count=sequences, depths=BOTH, aside_m=1.5, sequence=SEQUENCE, step_m=3.0
        ),
    )
    return SimulationPlan(
        name="calibration-repeating", city="repeating", seed=CALIBRATION_SEEDS[_REPEATING], queries=drives
    )
