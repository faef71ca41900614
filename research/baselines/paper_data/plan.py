"""Plan of the comparison's RGB-D pairs: 7,600 for training, and twice the 626 test images of Table I.

The paper says "two training data sets, each with 7600 image pairs", but not how they were recorded. Half of our pairs
follow the survey traversal, half another one, in both lanes and directions with other vehicles. A method that trains on
pairs therefore knows queries of another traversal. The queries of ``same_drive`` lie on the survey's track among its
vehicles, like the paper's random split. The queries of ``other_drive`` come from a traversal that no training uses.
"""

from model_training.simulation.plan import QueryPlan, SimulationPlan
from research.baselines.paper_data.table_one import PAPER_PAIRS

TRAINING_SETS = ("own_drive_precise", "second_drive_precise")
SPLITS = ("same_drive", "other_drive")
#: Spacing of the survey's scans at the paper's size, metres.
DENSEST_M = 0.5
#: Largest spacing of the survey's scans, metres: with all test images, and in a reduced run, whose map is sparse.
SPARSEST_M, SPARSEST_REDUCED_M = 4.0, 20.0
#: Traversals of the tests and of the second training set. Nothing else in the project uses these numbers in this city.
TEST_TRAVERSAL, TRAINING_TRAVERSAL = 6, 20


def pairs_plan(pairs: int, *, test_images: int | None = None) -> SimulationPlan:
    """Plan the paper's city with its training pairs and both tests.

    Args:
        pairs: number of training pairs.
        test_images: test images per split; None for Table I's 626.
    """

    def test(name: str, traversal: int, *, on_track: bool) -> QueryPlan:
        few = test_images or 64  # has no effect with Table I's counts
        return QueryPlan(name=name, traversal=traversal, on_track=on_track, per_class=test_images is None, count=few)

    queries = (
        QueryPlan(name="own_drive", traversal=0, on_track=True, count=pairs // 2),
        QueryPlan(name="second_drive", traversal=TRAINING_TRAVERSAL, count=pairs - pairs // 2),
        test("same_drive", 0, on_track=True),
        test("other_drive", TEST_TRAVERSAL, on_track=False),
    )
    # The survey needs as many stations as its own pairs, and a margin for blocked stations.
    most_m = SPARSEST_M if test_images is None else SPARSEST_REDUCED_M
    spacing_m = min(most_m, DENSEST_M * (PAPER_PAIRS // 2) / max(1, pairs // 2))
    return SimulationPlan(name="paper-comparison", city="paper", seed=0, spacing_m=spacing_m, queries=queries)
