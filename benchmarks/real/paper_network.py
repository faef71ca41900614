"""Train the paper's network in the simulator, once, for the comparison on real streets.

It learns from a tenth of the paper's LiDAR frames and a fifth of its image pairs. ``make paper`` compares trainings of the full size.
"""

from pathlib import Path

from benchmarks.paper.data import PaperData, Size
from model_training.cli.progress import bars
from research.baselines.paper.cnn import PaperCnn
from research.baselines.paper.train import PATIENCE, CnnTrainer
from research.baselines.paper.variants import PLANS
from research.baselines.paper_data.table_one import PAPER_FRAMES

#: The variant that finds most streets in the paper's city (``reports/paper.md``), and the only one that learns from image pairs.
VARIANT = "one_space_both"
SIZE = Size(frames=4_674, pairs=1_520, test_images=24)
#: Most processor time of the training, seconds. It ends earlier when the validation accuracy stops rising for as many images as in
#: ``make paper``. The points of the curve are a quarter of an epoch apart, so fewer frames need more points.
BUDGET_S, PATIENCE_POINTS = 600.0, round(PATIENCE * PAPER_FRAMES / SIZE.frames)


def paper_network(work: Path) -> PaperCnn:
    """Return the trained network. Data and training of an earlier run are used again; a stopped run continues.

    Args:
        work: folder of data and training.
    """
    data = PaperData(work, SIZE)
    trainer = CnnTrainer(
        PLANS[VARIANT], data.frames, data.pairs, work / "training", budget_s=BUDGET_S, patience=PATIENCE_POINTS
    )
    with bars() as show:
        return trainer.run("paper's network", show)
