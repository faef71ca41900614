"""The baseline from beginning to end: both trainings within a budget, then the answers to the tests."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from model_training.baselines.learning import Report, Training
from model_training.baselines.paper_data.pairs import Pairs
from model_training.baselines.regression.locate import Method, StageAnswers, locate_by_stage
from model_training.baselines.regression.map_cloud import make_map_cloud, small_gicp_package
from model_training.baselines.regression.train_lk import LkSettings, load_lk, train_lk
from model_training.baselines.regression.train_pose import PoseRegressor, PoseSettings, train_pose
from model_training.datasets.dataset import Dataset
from service.errors import DatasetError
from service.maps.streets import Streets

GOOGLENET_SHARE = 0.75  # of the budget; PointNetLK has the rest


@dataclass(frozen=True, slots=True)
class TrainingCost:
    """Of one network: processor time (s), pictures or clouds shown, why it ended, and where its curve lies."""

    processor_s: float
    images: int
    ended: str
    curve: Path


@dataclass(frozen=True, slots=True, eq=False)
class RegressionResult:
    """``answers``: by split, then by stage (``locate.STAGES``); ``trainings``: of ``googlenet`` and ``pointnet_lk``."""

    answers: Mapping[str, Mapping[str, StageAnswers]]
    trainings: Mapping[str, TrainingCost]

    @property
    def processor_s(self) -> float:
        """Of both trainings."""
        return sum(cost.processor_s for cost in self.trainings.values())


def run(
    pairs: Pairs, dataset_folder: Path, tests: Mapping[str, Pairs], work: Path, *, budget_s: float = 3600.0,
    report: Report = lambda *_: None, pose: PoseSettings | None = None, lk: LkSettings | None = None,
) -> RegressionResult:  # fmt: skip
    """Train on pairs, or go on with what a stopped run left in ``work``, and locate the pairs of each test.

    Args:
        pairs: to learn from.
        dataset_folder: whose survey is the map, and whose streets are answered.
        tests: by split.
        work: keeps the map cloud, checkpoints and curves.
        budget_s: processor time of both trainings.
        report: stage, done, of.
        pose: settings of GoogLeNet.
        lk: settings of PointNetLK.

    Raises:
        DatasetError: the dataset has no streets, or ``work`` belongs to other settings.
        ExtraMissingError: small_gicp is not installed.
    """
    small_gicp_package()  # before an hour of training, not after it
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
