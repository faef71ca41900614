"""Builds and an update on a Ray cluster of two nodes, whose workers, node and driver are killed.

Needs the extra ``ray`` (``make test-ray``).
"""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from model_training.mapping.work import work_folder
from tests.unit.ray_nodes import require_survival, running_tasks, until

ray = pytest.importorskip("ray", reason="needs the extra `ray`")

COMMAND = "from service.cli.start import main; main()"
TILE_M = 50


def files_of(folder: Path) -> dict[str, bytes]:
    """Return every file of a map; manifests without the time of the build."""
    found = {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}
    for name in [name for name in found if name.endswith("manifest.json")]:
        manifest = json.loads(found[name])
        del manifest["made_at"]
        found[name] = json.dumps(manifest).encode()
    return found


@pytest.fixture
def command(ray_cluster: Any) -> Iterator[Callable[..., Any]]:
    """Return what starts a command as a user does, in a process of its own."""
    started: list[subprocess.Popen[str]] = []

    def start(*arguments: str) -> "subprocess.Popen[str]":
        process = subprocess.Popen(
            [sys.executable, "-c", COMMAND, *arguments],
            env=os.environ | {"RAY_ADDRESS": ray_cluster.address},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        started.append(process)
        return process

    yield start
    for process in started:
        process.kill()
        process.communicate()


@pytest.fixture
def start(command: Callable[..., Any], small_dataset: Any, encoder_file: Path, tmp_path: Path) -> Callable[..., Any]:
    """Return what starts a build."""

    def build(name: str, engine: str = "ray", survey: str = str(small_dataset.folder)) -> "subprocess.Popen[str]":
        settings = ["--name", "tiled", "--headings", "6", "--spacing", "5", "--voxel", "0.6", "--tile-m", str(TILE_M)]
        files = ["--out", str(tmp_path / name), "--encoder", str(encoder_file)]
        process: subprocess.Popen[str] = command(
            "build-map", survey, *files, *settings, "--engine", engine, "--workers", "2"
        )
        return process

    return build


@pytest.fixture
def undisturbed(start: Callable[..., Any], tmp_path: Path) -> dict[str, bytes]:
    """Return the files of a build in local processes."""
    process = start("local", "local")
    _, said = process.communicate(timeout=300)
    assert process.returncode == 0, said
    return files_of(tmp_path / "local")


def test_a_build_survives_a_killed_worker_and_a_lost_node(
    ray_cluster: Any, start: Callable[..., Any], undisturbed: dict[str, bytes], tmp_path: Path
) -> None:
    require_survival(ray_cluster, start("m"))
    assert files_of(tmp_path / "m") == undisturbed


def test_a_killed_driver_loses_and_duplicates_nothing(
    start: Callable[..., Any], undisturbed: dict[str, bytes], tmp_path: Path
) -> None:
    process = start("m")
    until(running_tasks)
    process.kill()
    process.communicate()
    assert not (tmp_path / "m").exists()
    until(lambda: not running_tasks())
    process = start("m")
    _, said = process.communicate(timeout=300)
    assert process.returncode == 0, said
    assert files_of(tmp_path / "m") == undisturbed
    assert not work_folder(tmp_path / "m").exists()


def test_the_nodes_fetch_a_survey_from_object_storage(
    survey_url: str, start: Callable[..., Any], undisturbed: dict[str, bytes], tmp_path: Path
) -> None:
    """One task is killed after it has begun. Another one fetches what is missing."""
    process = start("m", survey=survey_url)
    os.kill(until(running_tasks)[0], signal.SIGKILL)
    _, said = process.communicate(timeout=300)
    assert process.returncode == 0, said
    assert files_of(tmp_path / "m") == undisturbed
    assert sorted(path.name for path in tmp_path.iterdir()) == ["local", "m"]


@pytest.mark.usefixtures("undisturbed")
def test_an_update_survives_a_killed_worker_and_a_lost_node(
    ray_cluster: Any, command: Callable[..., Any], small_dataset: Any, tmp_path: Path
) -> None:
    """The survey of the map takes the place of its content, so both tiles change."""
    update = ["map", "update", str(tmp_path / "local"), str(small_dataset.folder), "--replace", "--workers", "2"]
    process = command(*update, "--engine", "local", "--out", str(tmp_path / "expected"))
    _, said = process.communicate(timeout=300)
    assert process.returncode == 0, said
    require_survival(ray_cluster, command(*update, "--engine", "ray", "--out", str(tmp_path / "m")))
    assert files_of(tmp_path / "m") == files_of(tmp_path / "expected")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["expected", "local", "m"]
