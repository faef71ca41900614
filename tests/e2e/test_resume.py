"""Builds that are killed from outside, as a machine that goes down would, and started again."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from benchmarks.real.resume import content_of, identical_bundles
from model_training.simulation.plan import SimulationPlan
from model_training.simulation.sensor_parameters import LidarParameters
from model_training.simulation.simulate import simulate
from service.maps.reader import MapBundle

BUILD = "from service.cli.main import main; main()"
#: The same, with Ctrl-C pressed as soon as the first part of the places is kept; heard even where tests run in the background, whose
#: processes are born deaf to it.
INTERRUPTED = (
    """
import os, signal
from model_training.mapping import work

signal.signal(signal.SIGINT, signal.default_int_handler)
keep = work._write

def kept(path, arrays):
    keep(path, arrays)
    if path.name.startswith("places-"):
        os.kill(os.getpid(), signal.SIGINT)

work._write = kept
"""
    + BUILD
)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Some 90 scans of few points, without queries: a chunk of places and a part of one."""
    out = tmp_path_factory.mktemp("resume") / "town"
    plan = SimulationPlan(
        name="town",
        seed=3,
        size_m=(60.0, 60.0),
        spacing_m=0.8,
        streets=("1",),
        lidar="vlp_16",
        lidar_parameters=LidarParameters(columns=256),
        queries=(),
    )
    simulate(plan, out, workers=1)
    return out


@pytest.fixture(scope="module")
def options(encoder_of: Callable[..., bytes], tmp_path_factory: pytest.TempPathFactory) -> tuple[str, ...]:
    path = tmp_path_factory.mktemp("encoders") / "encoder.onnx"
    path.write_bytes(encoder_of())
    return ("--encoder", str(path), "--spacing", "0.8", "--headings", "6")


@pytest.fixture(scope="module")
def killed(
    dataset: Path, options: tuple[str, ...], tmp_path_factory: pytest.TempPathFactory
) -> tuple[tuple[int, ...], Path]:
    """Return which of two killed builds ended as the undisturbed one, and the bundle of the undisturbed one."""
    work = tmp_path_factory.mktemp("killed") / "builds"
    return identical_bundles(dataset, work, builds=2, seed=1, options=options), work / "undisturbed"


def test_killed_builds_end_with_the_bytes_of_an_undisturbed_one(killed: tuple[tuple[int, ...], Path]) -> None:
    assert killed[0] == (1, 1)


def test_a_build_interrupted_from_the_keyboard_goes_on(
    dataset: Path, options: tuple[str, ...], killed: tuple[tuple[int, ...], Path], tmp_path: Path
) -> None:
    """Interrupted when its first part is finished; the part is still there, and nothing under the bundle's name."""
    out, parts = tmp_path / "m", tmp_path / ".m.building"

    def build(program: str = BUILD) -> int:
        command = [sys.executable, "-c", program, "build-map", str(dataset), "--out", str(out), "--name", "resumed"]
        return subprocess.run([*command, *options], capture_output=True, timeout=300, check=False).returncode

    assert build(INTERRUPTED) == 130
    assert len(list(parts.glob("places-*.npz"))) == 1
    assert not out.exists()
    assert build() == 0
    assert MapBundle.open(out).manifest.counts.places > 64
    assert not parts.exists()
    assert content_of(out) == content_of(killed[1])
