"""The baseline from beginning to end: both trainings within a budget, then the answers to the tests."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from model_training.datasets.dataset import Dataset
from research.baselines.learning import Report, Training
from research.baselines.paper_data.pairs import Pairs
from research.baselines.regression.locate import Method, StageAnswers, locate_by_stage
from research.baselines.regression.map_cloud import make_map_cloud, small_gicp_package
from research.baselines.regression.train_lk import LkSettings, load_lk, train_lk
from research.baselines.regression.train_pose import PoseRegressor, PoseSettings, train_pose
from service.errors import DatasetError
from service.maps.streets import Streets

#: Share of the budget for GoogLeNet. PointNetLK has the rest.
GOOGLENET_SHARE = 0.75


@dataclass(frozen=True, slots=True)
class TrainingCost:
    """Cost of the training of one network.

    Attributes:
        processor_s: processor time, seconds.
        images: images or clouds shown.
        ended: why the training ended.
        curve: file of the curve.
    """

    processor_s: float
    images: int
    ended: str
    curve: Path


@dataclass(frozen=True, slots=True, eq=False)
class RegressionResult:
    """Answers and training costs.

    Attributes:
        answers: answers by split, then by stage (``locate.STAGES``).
        trainings: costs of ``googlenet`` and ``pointnet_lk``.
    """

    answers: Mapping[str, Mapping[str, StageAnswers]]
    trainings: Mapping[str, TrainingCost]

    @property
    def processor_s(self) -> float:
        """Processor time of both trainings, seconds."""
        return sum(cost.processor_s for cost in self.trainings.values())


def run(
    pairs: Pairs,
    dataset_folder: Path,
    tests: Mapping[str, Pairs],
    work: Path,
    *,
    budget_s: float = 3600.0,
    report: Report = lambda *_: None,
    pose: PoseSettings | None = None,
    lk: LkSettings | None = None,
) -> RegressionResult:
    """Train on pairs, or resume a stopped run in ``work``, and locate the pairs of each test.

    Args:
        pairs: RGB-D training pairs.
        dataset_folder: dataset whose survey is the map, with the streets to answer.
        tests: RGB-D queries by split.
        work: folder of the map cloud, checkpoints and curves.
        budget_s: budget of both trainings, processor seconds.
        report: receives stage, number done and total.
        pose: settings of GoogLeNet; None for the defaults.
        lk: settings of PointNetLK; None for the defaults.

    Raises:
        DatasetError: the dataset has no streets, or ``work`` belongs to other settings.
        ExtraMissingError: small_gicp is not installed.
    """
    small_gicp_package()  # fail before the training, not after an hour
    dataset = Dataset(dataset_folder)
    streets = dataset.streets()
    if streets is None:
        raise DatasetError(f"{dataset_folder} has no streets.geojson", field="streets")
    cloud = make_map_cloud(dataset, work / "map_cloud.npy", report=report)
    first = train_pose(pairs, work / "googlenet", pose, budget_s=GOOGLENET_SHARE * budget_s, report=report)
    second = train_lk(pairs, cloud, work / "pointnet_lk", lk, budget_s=(1 - GOOGLENET_SHARE) * budget_s, report=report)
    method = Method(PoseRegressor.of(first), load_lk(second), cloud, Streets.from_geojson(streets))
    answers = {split: locate_by_stage(method, test, report=report) for split, test in tests.items()}
    return RegressionResult(answers, {"googlenet": _cost(first), "pointnet_lk": _cost(second)})


def _cost(training: Training) -> TrainingCost:
    return TrainingCost(
        training.curve[-1].processor_s, training.images, training.ended or "", training.folder / "curve.jsonl"
    )
