"""Training cities from a Ray cluster whose worker, node and driver are killed. Needs the extra ``ray`` (``make test-ray``)."""

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.unit.ray_nodes import require_survival, running_tasks, until

ray = pytest.importorskip("ray", reason="needs the extra `ray`")

#: Three cities that take a second or two each, so that a task can be killed while it runs.
CITIES = """
import sys
from model_training.training.archive_places import archives_at
from model_training.training.city_engines import simulate_archives
from model_training.training.packs import PackPlan
from service.imaging.view_grid import ViewGrid

plans = [
    PackPlan(seed=seed, places=24, queries_a_place=1, lidar="vlp_16", size_m=(60.0, 60.0)) for seed in (1002, 1003, 1004)
]
simulate_archives(
    plans,
    archives_at(sys.argv[1]),
    ViewGrid(),
    engine=sys.argv[2],
    workers=2,
    warn=lambda text: print(text, file=sys.stderr, flush=True),
)
"""


def files_of(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Return the archives of local processes."""
    folder = tmp_path_factory.mktemp("local")
    subprocess.run([sys.executable, "-c", CITIES, folder, "local"], check=True, timeout=300)
    assert len(files_of(folder)) == 3
    return files_of(folder)


@pytest.fixture
def start(undisturbed: dict[str, bytes], ray_cluster: Any, tmp_path: Path) -> Iterator[Callable[[], Any]]:
    """Return what starts the simulation on the cluster, in a process of its own."""
    started: list[subprocess.Popen[str]] = []

    def simulate() -> "subprocess.Popen[str]":
        command = [sys.executable, "-c", CITIES, str(tmp_path / "cities"), "ray"]
        environment = os.environ | {"RAY_ADDRESS": ray_cluster.address}
        started.append(subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True))
        return started[-1]

    yield simulate
    for process in started:
        process.kill()
        process.wait()


def test_ray_loses_no_city_with_a_killed_worker_and_a_lost_node(
    ray_cluster: Any, start: Callable[[], Any], undisturbed: dict[str, bytes], tmp_path: Path
) -> None:
    require_survival(ray_cluster, start())
    assert files_of(tmp_path / "cities") == undisturbed


def test_ray_goes_on_after_its_driver_was_killed(
    start: Callable[[], Any], undisturbed: dict[str, bytes], tmp_path: Path
) -> None:
    process = start()
    until(lambda: list((tmp_path / "cities").glob("*.tar")))
    process.kill()
    process.communicate()
    until(lambda: not running_tasks())
    first = {path: path.stat().st_ino for path in (tmp_path / "cities").glob("*.tar")}
    process = start()
    _, said = process.communicate(timeout=300)
    assert process.returncode == 0, said
    assert files_of(tmp_path / "cities") == undisturbed
    assert all(path.stat().st_ino == number for path, number in first.items())  # finished cities are not made again
