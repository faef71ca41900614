from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from model_training.simulation.city import City
from model_training.simulation.meshes import Material, MeshBuilder
from model_training.simulation.plan import CameraPlan, QueryPlan, SimulationPlan
from model_training.simulation.scene import Scene
from model_training.simulation.simulate import simulate
from model_training.simulation.terrain import GroundPicture


def make_plan(**changed) -> SimulationPlan:
    """Return a plan of two dozen scans and six image pairs, in a city of five short streets."""
    query = QueryPlan(name="drive1", traversal=1, count=6, depths=("precise", "stereo"))
    given = {
        "name": "tiny",
        "seed": 3,
        "size_m": (60.0, 60.0),
        "spacing_m": 12.0,
        "camera": CameraPlan(width=96, height=72),
        "queries": (query,),
    }
    return SimulationPlan(**(given | changed))


@pytest.fixture(scope="session")
def plan_of() -> Callable[..., SimulationPlan]:
    return make_plan


@pytest.fixture(scope="session")
def tiny_dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("simulated") / "tiny"
    simulate(make_plan(), out, workers=1)
    return out


@pytest.fixture(scope="session")
def city() -> City:
    return City(seed=5, size_m=(160.0, 160.0))


@pytest.fixture(scope="session")
def wall() -> SimpleNamespace:
    """Return one matte wall, 200 m wide and 100 m high, perpendicular to x at x = 20 m, and a ground image for shading."""
    builder = MeshBuilder()
    builder.box(np.array([21.0, 0.0, -50.0]), (2.0, 200.0, 100.0), 0.0, np.full(3, 0.5), Material.MATTE)
    return SimpleNamespace(
        scene=Scene(builder.mesh()), ground=GroundPicture(np.zeros((8, 8), np.uint8), (0.0, 0.0)), x_m=20.0
    )
