"""The RGB-D pairs of the comparison: 7,600 to learn from, and twice the 626 test images of Table I.

The paper says "two training data sets, each with 7600 image pairs" and not how they were driven. Half of ours ride on the
survey's own drive, half on another, in both lanes and both directions with other vehicles, so that a method that learns from
pairs has seen what the other drive's questions look like. The questions of ``same_drive`` stand on the survey's own track among
its own vehicles, as the paper's random split has it; those of ``other_drive`` come from a drive that nothing was learnt from.
"""

from model_training.baselines.paper_data.table_one import PAPER_PAIRS
from model_training.simulation.plan import QueryPlan, SimulationPlan

TRAINING_SETS = ("own_drive_precise", "second_drive_precise")
SPLITS = ("same_drive", "other_drive")
DENSEST_M = 0.5  # between scans of the survey at the paper's size
TEST_TRAVERSAL, TRAINING_TRAVERSAL = 6, 20  # nothing else in the project drives these here


def pairs_plan(pairs: int, *, test_images: int | None = None) -> SimulationPlan:
    """The paper's city with its training pairs and both tests.

    Args:
        pairs: to learn from.
        test_images: for each split; None for Table I's 626.
    """

    def test(name: str, traversal: int, *, on_track: bool) -> QueryPlan:
        few = test_images or 64  # says nothing where Table I does
        return QueryPlan(name=name, traversal=traversal, on_track=on_track, per_class=test_images is None, count=few)

    queries = (
        QueryPlan(name="own_drive", traversal=0, on_track=True, count=pairs // 2),
        QueryPlan(name="second_drive", traversal=TRAINING_TRAVERSAL, count=pairs - pairs // 2),
        test("same_drive", 0, on_track=True),
        test("other_drive", TEST_TRAVERSAL, on_track=False),
    )
    # As many stations as the survey's own drive has pairs to stand on, and a margin for those that are blocked.
    spacing_m = min(4.0, DENSEST_M * (PAPER_PAIRS // 2) / max(1, pairs // 2))
    return SimulationPlan(name="paper-comparison", city="paper", seed=0, spacing_m=spacing_m, queries=queries)
