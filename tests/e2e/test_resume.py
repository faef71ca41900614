"""Builds that are killed from outside, as a machine that goes down would, and started again."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from benchmarks.real.resume import content_of, identical_bundles
from model_training.simulation.plan import SimulationPlan
from model_training.simulation.simulate import simulate
from service.maps.reader import MapBundle


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Some 150 scans without queries: two chunks of places and a part of one."""
    out = tmp_path_factory.mktemp("resume") / "town"
    plan = SimulationPlan(
        name="town", seed=3, size_m=(60.0, 60.0), spacing_m=0.5, streets=("1",), lidar="vlp_16", queries=()
    )
    simulate(plan, out, workers=1)
    return out


@pytest.fixture(scope="module")
def options(encoder_of: Callable[..., bytes], tmp_path_factory: pytest.TempPathFactory) -> tuple[str, ...]:
    path = tmp_path_factory.mktemp("encoders") / "encoder.onnx"
    path.write_bytes(encoder_of())
    return ("--encoder", str(path), "--spacing", "0.5", "--headings", "6")


def test_killed_builds_end_with_the_bytes_of_an_undisturbed_one(
    dataset: Path, options: tuple[str, ...], tmp_path: Path
) -> None:
    assert identical_bundles(dataset, tmp_path / "builds", builds=2, seed=1, options=options) == (1, 1)


def test_a_build_interrupted_from_the_keyboard_goes_on(dataset: Path, options: tuple[str, ...], tmp_path: Path) -> None:
    """Interrupted when its first part is finished; the part is still there, and nothing under the bundle's name."""
    out = tmp_path / "m"
    arguments = [
        sys.executable,
        "-c",
        "from service.cli.main import main; main()",
        "build-map",
        str(dataset),
        "--out",
        str(out),
    ]
    process = subprocess.Popen([*arguments, *options], stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    parts = tmp_path / ".m.building"
    deadline = time.monotonic() + 120
    while not list(parts.glob("places-*.npz")) and process.poll() is None and time.monotonic() < deadline:
        os.sched_yield()
    process.send_signal(signal.SIGINT)
    assert process.wait(timeout=60) != 0
    assert list(parts.glob("places-*.npz"))
    assert not out.exists()
    subprocess.run([*arguments, *options], check=True, capture_output=True, timeout=300)
    assert MapBundle.open(out).manifest.counts.places > 64
    assert not parts.exists()
    subprocess.run(
        [*arguments[:-1], str(tmp_path / "undisturbed"), *options], check=True, capture_output=True, timeout=300
    )
    assert content_of(out) == content_of(tmp_path / "undisturbed")
