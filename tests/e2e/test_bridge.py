"""The real bridge in a process of its own, asked over real DDS on loopback."""

import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import uvicorn

from benchmarks.real.ros2 import LOOPBACK, answers_over_dds
from service.http.app import create_app
from service.runtime.engine import Engine
from service.runtime.settings import Settings

COMMAND = [sys.executable, "-c", "from service.cli.main import main; main()", "bridge", "ros2"]


@pytest.fixture
def url(bundle_path: Path) -> Iterator[str]:
    engine = Engine.open(Settings(maps=(bundle_path,), threads=1, queue=16))
    server = uvicorn.Server(uvicorn.Config(create_app(engine), port=0, log_config=None, lifespan="off"))
    thread = threading.Thread(target=server.run)
    thread.start()
    while not server.started:
        assert thread.is_alive()
    yield f"http://127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}"
    server.should_exit = True
    thread.join()
    engine.close()


def test_every_frame_comes_back_as_a_pose_from_a_map(bundle_path: Path, pictures: Any) -> None:
    assert answers_over_dds(str(bundle_path), [pictures], count=5) == 5


def test_every_frame_comes_back_as_a_pose_from_a_service(url: str, pictures_of: Callable[..., Any]) -> None:
    frames = (pictures_of(seed=seed) for seed in (3, 4))
    assert answers_over_dds(url, frames, count=5) == 5


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_cleanly(bundle_path: Path, number: signal.Signals) -> None:
    process = subprocess.Popen(
        [*COMMAND, "--map", str(bundle_path), "--domain", str(20 + os.getpid() % 200)],
        env=os.environ | {"CYCLONEDDS_URI": LOOPBACK},
        stdout=subprocess.PIPE,
        text=True,
        bufsize=1,
    )
    assert process.stdout is not None
    assert re.match(r"listening to /camera/color/image_raw .*Ctrl-C", process.stdout.readline())
    process.send_signal(number)
    rest, _ = process.communicate(timeout=60)
    assert (process.returncode, rest) == (0, "stopped\n")


def test_a_map_that_is_none_is_told_at_once(tmp_path: Path) -> None:
    done = subprocess.run([*COMMAND, "--map", str(tmp_path)], capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 1
    assert done.stderr.startswith("streetfix: ")
    assert "Traceback" not in done.stderr


def test_a_dds_that_does_not_start_is_told(bundle_path: Path) -> None:
    done = subprocess.run(
        [*COMMAND, "--map", str(bundle_path)],
        env=os.environ | {"CYCLONEDDS_URI": "<CycloneDDS><Domain><Nonsense/>"},
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert done.returncode == 1
    assert "check --domain and the environment's CYCLONEDDS_URI" in done.stderr
