"""The clients and a real service in a process of its own: one answer through every one of them, and README's example."""

import asyncio
import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from service.client import (
    AsyncClient,
    Client,
    Frame,
    GrpcClient,
    LocalizeAnswer,
    PinholeCamera,
    Prior,
    PriorPosition,
    RefusedError,
    RetryPolicy,
    UnreachableError,
)

ROOT = Path(__file__).parents[2]
COMMAND = [sys.executable, "-c", "from service.cli.main import main; main()"]


@dataclass
class Served:
    url: str
    grpc: str


@pytest.fixture(scope="module")
def served(bundle_path: Path) -> Iterator[Served]:
    process = subprocess.Popen(
        [*COMMAND, "serve", str(bundle_path), "--port", "0", "--grpc-port", "0", "--threads", "1"],
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    said = ""
    for line in process.stdout:
        said += line
        if found := re.search(r"serving at (http://\S+)", line):
            break
    else:
        raise AssertionError(f"the service ended with {process.wait()} and never served")
    grpc = re.search(r"serving gRPC at (\S+)", said)
    assert grpc
    yield Served(found[1], grpc[1])
    process.send_signal(signal.SIGTERM)
    process.communicate(timeout=60)


def untimed(answer: LocalizeAnswer | RefusedError) -> dict[str, Any]:
    assert isinstance(answer, LocalizeAnswer)
    return answer.model_dump(exclude={"timings_ms"})


def test_every_client_gets_the_same_answer(served: Served, pictures: Any) -> None:
    prior = Prior(position=PriorPosition(x=20.0, y=100.0, std_m=10.0), heading_deg=90.0)

    async def ask() -> LocalizeAnswer:
        async with AsyncClient(served.url) as client:
            return await client.localize(*pictures, prior=prior)

    with Client(served.url) as client, GrpcClient(served.grpc) as over_grpc:
        answers = [
            client.localize(*pictures, prior=prior),
            over_grpc.localize(*pictures, prior=prior),
            asyncio.run(ask()),
        ]
    assert untimed(answers[0]) == untimed(answers[1]) == untimed(answers[2])
    assert answers[0].status == "LOCALIZED"
    assert answers[0].street is not None
    assert answers[0].street.name == "End of street 2"
    assert answers[0].pose is not None
    assert np.hypot(answers[0].pose.position.x - 20.0, answers[0].pose.position.y - 100.0) < 0.5


@pytest.mark.parametrize("kind", ["rest", "grpc"])
def test_sequences_batches_and_maps(served: Served, pictures: Any, kind: str) -> None:
    rgb, depth_m, camera = pictures
    frame = Frame(rgb=rgb, depth=depth_m, camera=camera)
    blind = Frame(rgb=rgb, depth=np.zeros_like(depth_m), camera=camera)
    same = Frame(rgb=rgb, depth=depth_m, camera=camera, T_reference_camera=np.eye(4))
    with Client(served.url) if kind == "rest" else GrpcClient(served.grpc) as client:
        assert client.localize_sequence([frame, same]).neighbours[0].place == 8
        first, second = client.localize_batch([frame, blind])
        assert untimed(first) == untimed(client.localize(rgb, depth_m, camera))
        assert isinstance(second, RefusedError)
        assert (second.problem, second.field) == ("no-depth", "requests.1.depth")
        (entry,) = client.maps()
        assert entry.name == "tiny"
        assert len(client.streets("tiny")["features"]) == 3
        assert client.coverage()["features"][0]["properties"]["map"] == "tiny"


@pytest.mark.parametrize("kind", ["rest", "grpc"])
def test_a_refusal_says_the_same_through_both(served: Served, pictures: Any, kind: str) -> None:
    rgb, depth_m, _ = pictures
    with Client(served.url) if kind == "rest" else GrpcClient(served.grpc) as client:
        with pytest.raises(RefusedError) as caught:
            client.localize(rgb, depth_m, PinholeCamera(64, 64, 32.0, 32.0, 31.5, 31.5))
        assert (caught.value.problem, caught.value.field) == ("image-size", "rgb")
        assert re.fullmatch(r"\w{32}", caught.value.request_id)
        with pytest.raises(RefusedError) as caught:
            client.localize(*pictures, map="west")
        assert caught.value.problem == "unknown-map"
        assert "mounted maps: tiny" in caught.value.detail


@pytest.mark.parametrize("kind", ["rest", "grpc"])
def test_nobody_at_the_address_is_told_with_the_remedy(pictures: Any, kind: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        address = f"127.0.0.1:{taken.getsockname()[1]}"
    once = RetryPolicy(attempts=1)
    with (
        Client(f"http://{address}", retry=once) if kind == "rest" else GrpcClient(address, retry=once) as client,
        pytest.raises(UnreachableError, match="streetfix serve BUNDLE"),
    ):
        client.localize(*pictures)


def test_the_readmes_example_runs(served: Served, pictures: Any, tmp_path: Path) -> None:
    section = (ROOT / "README.md").read_text().split("## From Python", 1)[1]
    found = re.search(r"```python\n(.*?)```", section, re.DOTALL)
    assert found
    rgb, depth_m, _ = pictures  # 64 x 48 pixels of the same camera
    for name, file, picture in (
        ("rgb", "000000.jpg", rgb[..., ::-1]),
        ("depth", "000000.png", (1000 * depth_m).astype(np.uint16)),
    ):
        folder = tmp_path / "data" / "small" / "queries" / "drive1_precise" / name
        folder.mkdir(parents=True)
        assert cv2.imwrite(str(folder / file), picture)
    assert "http://127.0.0.1:8000" in found[1]
    program = found[1].replace("http://127.0.0.1:8000", served.url)
    done = subprocess.run(
        [sys.executable, "-c", program],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("LOCALIZED ")
    assert done.stdout.endswith("['tiny']\n")
