"""The load test as a user runs it, against the real service over both faces."""

import io
import json
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from service.cli.main import main

COMMAND = [sys.executable, "-c", "from service.cli.main import main; main()"]
Parts = Callable[..., dict[str, bytes]]


@pytest.fixture(scope="module")
def service(bundle_path: Path) -> Iterator[dict[str, Any]]:
    process = subprocess.Popen(
        [*COMMAND, "serve", str(bundle_path), "--threads", "1", "--queue", "1", "--port", "0", "--grpc-port", "0"],
        stdout=subprocess.PIPE,
        text=True,
    )
    found: dict[str, Any] = {"pid": process.pid}
    assert process.stdout is not None
    for line in process.stdout:
        if match := re.search(r"serving (gRPC )?at (\S+)", line):
            found["grpc" if match[1] else "url"] = match[2]
        if "url" in found:
            break
    yield found
    process.send_signal(signal.SIGTERM)
    process.communicate(timeout=60)
    assert process.returncode == 0


@pytest.fixture(scope="module")
def dataset(parts_of: Parts, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two query pairs as `import` would write them: the true place of the tiny map, 2 m beside it the second time."""
    import cv2

    folder = tmp_path_factory.mktemp("dataset")
    parts = parts_of()
    request = json.loads(parts["request"])
    camera = {name: request["camera"][name] for name in ("width", "height", "fx", "fy", "cx", "cy")}
    sensors = {"cameras": [camera | {"name": "camera", "depth": {"scale_m": 0.001, "kind": "z"}}]}
    (folder / "dataset.json").write_text(
        json.dumps({"format": 1, "name": "tiny", "source": {"kind": "test"}, "sensors": sensors})
    )
    queries = folder / "queries" / "drive"
    depth_mm = (1000 * np.load(io.BytesIO(parts["depth"]))).astype(np.uint16)
    for k in range(2):
        for kind, content in (("rgb", parts["rgb"]), ("depth", cv2.imencode(".png", depth_mm)[1].tobytes())):
            (queries / kind).mkdir(parents=True, exist_ok=True)
            (queries / kind / f"{k:06}.png").write_bytes(content)
    half = np.sqrt(0.5)
    (queries / "poses.txt").write_text("".join(f"{k} {20 + 2 * k} 100 1.5 {-half} 0 0 {half}\n" for k in range(2)))
    return folder


def load(*arguments: str) -> "subprocess.CompletedProcess[str]":
    short = ("--warm-up", "0.5", "--duration", "2")
    return subprocess.run(
        [*COMMAND, "loadtest", *short, *arguments], capture_output=True, text=True, check=False, timeout=120
    )


@pytest.mark.parametrize("face", ["rest", "grpc"])
def test_a_rate_is_offered_and_answers_are_checked(
    service: dict[str, Any], dataset: Path, tmp_path: Path, face: str
) -> None:
    where = ("--url", service["url"]) if face == "rest" else ("--grpc", service["grpc"])
    done = load(
        "--dataset",
        str(dataset),
        *where,
        "--rate",
        "4",
        "--pid",
        str(service["pid"]),
        "--json",
        str(tmp_path / "load.json"),
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert "4/s" in done.stdout
    (found,) = json.loads((tmp_path / "load.json").read_text())
    assert found["answered_per_s"] > 0
    assert found["answers"] >= 3
    assert (found["errors"], found["inconsistent"]) == ({}, 0)
    assert found["answered_ms"]["p50"] <= found["answered_ms"]["p99"]
    assert found["localized"] == 1.0  # the tiny map is not calibrated
    assert 0 < found["right"] < 1  # the second pair's truth is 2 m away
    assert found["cpu_ms_per_answer"] > 0
    assert found["resident_mib"] > 30


def test_beyond_the_queue_refusals_are_counted(service: dict[str, Any], dataset: Path, tmp_path: Path) -> None:
    done = load(
        "--dataset", str(dataset), "--url", service["url"], "--concurrency", "8", "--json", str(tmp_path / "load.json")
    )
    assert done.returncode == 0, done.stderr
    (found,) = json.loads((tmp_path / "load.json").read_text())
    assert found["errors"]["503"] > 0
    assert found["answers"] > 0
    assert "x 503" in done.stdout


def test_a_curve_is_drawn(service: dict[str, Any], dataset: Path, tmp_path: Path) -> None:
    picture = tmp_path / "load.png"
    done = load(
        "--dataset", str(dataset), "--url", service["url"], "--rate", "2", "--rate", "5", "--plot", str(picture)
    )
    assert done.returncode == 0, done.stderr
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_what_cannot_be_done_is_said(
    service: dict[str, Any], dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The command refuses these before it sends a request, so they need no process of their own."""
    url = ("--url", service["url"])
    for arguments, told in (
        ((*url, "--dataset", str(tmp_path)), "dataset.json"),
        ((*url, "--dataset", str(dataset), "--queries", "north"), "the dataset has: drive"),
        ((*url, "--dataset", str(dataset), "--rate", "1", "--concurrency", "1"), "give one of them"),
        ((*url, "--dataset", str(dataset), "--rate", "0"), "must be positive"),
        ((*url, "--dataset", str(dataset), "--pid", "4194303"), "process not found"),
    ):
        with pytest.raises(SystemExit) as end:
            main(["loadtest", *arguments])
        assert end.value.code == 1
        assert told in capsys.readouterr().err


def test_a_service_that_answers_nothing_is_an_error(dataset: Path) -> None:
    done = load("--url", "http://127.0.0.1:9", "--dataset", str(dataset))
    assert done.returncode == 1, done.stdout
    assert "no request was answered" in done.stderr
    assert "Traceback" not in done.stderr
