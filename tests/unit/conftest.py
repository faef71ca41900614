"""A simulated drive and its map, for the packages that stand on both; made once, and only where a test asks for them."""

from pathlib import Path
from typing import Any

import pytest


@pytest.fixture(scope="session")
def small_dataset(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A dozen scans of a LiDAR that looks down (2 to -24.8 degrees) and five picture pairs of another drive."""
    from model_training.datasets.dataset import Dataset
    from model_training.simulation.plan import CameraPlan, QueryPlan, SimulationPlan
    from model_training.simulation.simulate import simulate

    out = tmp_path_factory.mktemp("datasets") / "small"
    plan = SimulationPlan(
        name="small", seed=3, size_m=(60.0, 60.0), spacing_m=5.0, streets=("1",), lidar="hdl_64",
        camera=CameraPlan(width=96, height=72), queries=(QueryPlan(name="drive1", traversal=1, count=5),),
    )  # fmt: skip
    simulate(plan, out, workers=1)
    return Dataset(out)


@pytest.fixture(scope="session")
def encoder_file(encoder_of: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A random projection, for views of 8 x 16 cells."""
    path: Path = tmp_path_factory.mktemp("encoders") / "encoder.onnx"
    path.write_bytes(encoder_of())
    return path


@pytest.fixture(scope="session")
def small_map(small_dataset: Any, encoder_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The bundle of ``small_dataset``, six headings a place."""
    from model_training.mapping.build import BuildSettings, build_map

    out: Path = tmp_path_factory.mktemp("maps") / "small"
    build_map(small_dataset, encoder_file, out, BuildSettings(name="small", headings=6, spacing_m=5.0), threads=1)
    return out
