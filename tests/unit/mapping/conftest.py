"""A drive in two halves, their maps, the map of the whole drive, and a copy of its survey on an S3 server."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.scale.s3_server import BUCKET
from model_training.datasets.dataset import Dataset
from model_training.mapping.build import build_map
from model_training.mapping.settings import BuildSettings
from model_training.simulation.plan import SimulationPlan
from model_training.simulation.sensor_parameters import LidarParameters
from model_training.simulation.simulate import simulate
from service.maps.store.remote import Remote

#: Its poses are exact, and what is merged is compared with what is built at once; bringing scans into agreement has tests of its own.
#: Without places between scans: two halves lack the ones between them.
#: Without the traffic vote, in which scans of two halves vote less than those of the whole: so sums of voxels add up exactly.
SETTINGS = BuildSettings(
    name="small", headings=6, spacing_m=5.0, between_m=0.0, calibration=None, align_survey=False, traffic_vote=False
)


class Part(Dataset):
    """Some scans of a dataset. ``demolished`` selects the points (n, 3; map frame) that no longer exist."""

    def __init__(self, folder: Path, numbers: list[int], demolished: Callable[[Any], Any] | None = None) -> None:
        super().__init__(folder)
        self.numbers, self.demolished = numbers, demolished

    def survey_poses(self) -> NDArray[np.float64]:
        return super().survey_poses()[self.numbers]

    def scan(self, number: int) -> NDArray[np.float32]:
        points = super().scan(self.numbers[number])
        if self.demolished is None:
            return points
        T = super().survey_poses()[self.numbers[number]]
        return points[~self.demolished(points[:, :3] @ T[:3, :3].T + T[:3, 3])]


@pytest.fixture(scope="session")
def sparse_survey(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Return the survey of ``small_dataset`` with a quarter of its points, for tests that compare maps only with each other.

    A build takes half as long.
    """
    out = tmp_path_factory.mktemp("datasets") / "sparse"
    plan = SimulationPlan(
        name="small",
        seed=3,
        size_m=(60.0, 60.0),
        spacing_m=5.0,
        streets=("1",),
        lidar="hdl_64",
        lidar_parameters=LidarParameters(columns=256, bottom_deg=-24.8),
        queries=(),
    )
    simulate(plan, out, workers=1)
    return Dataset(out)


@pytest.fixture(scope="session")
def part_of(small_dataset: Dataset) -> Callable[..., Dataset]:
    def made(numbers: Any, demolished: Any = None) -> Dataset:
        return Part(small_dataset.folder, list(numbers), demolished)

    return made


@pytest.fixture(scope="session")
def halves(small_dataset: Dataset, part_of: Callable[..., Dataset]) -> tuple[Dataset, Dataset]:
    count = len(small_dataset.survey_poses())
    return part_of(range(count // 2)), part_of(range(count // 2, count))


@pytest.fixture(scope="session")
def map_of(encoder_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    def made(dataset: Dataset, *, encoder: Path = encoder_file, **changed: Any) -> Path:
        out = tmp_path_factory.mktemp("maps") / "m"
        build_map(dataset, encoder, out, replace(SETTINGS, **changed), threads=1)
        return out

    return made


@pytest.fixture(scope="session")
def half_maps(halves: tuple[Dataset, Dataset], map_of: Callable[..., Path]) -> tuple[Path, Path]:
    return map_of(halves[0]), map_of(halves[1])


@pytest.fixture
def upload(s3: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[Dataset], str]:
    """Return a function that copies a survey to an S3 server and returns its URL. Later processes find the credentials."""
    for key, value in s3.items():
        monkeypatch.setenv(key, value)

    def uploaded(dataset: Dataset) -> str:
        url = f"s3://{BUCKET}/{tmp_path.name}/survey"
        remote = Remote.open(url)
        for name in ("dataset.json", "streets.geojson", "survey/poses.txt"):
            remote.put(name, dataset.folder / name)
        for name, *_ in dataset.scan_files():
            remote.put(f"survey/scans/{name}", dataset.folder / "survey" / "scans" / name)
        return url

    return uploaded


@pytest.fixture
def survey_url(small_dataset: Dataset, upload: Callable[[Dataset], str]) -> str:
    return upload(small_dataset)
