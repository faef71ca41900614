"""A service of two workers whose map is in object storage: an S3 server over a socket."""

import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from benchmarks.scale.s3_server import BUCKET, CREDENTIALS, s3_server
from model_training.loadtest.processes import descendants
from service.maps.content import BundleContent
from service.maps.store.transfer import push
from service.maps.tiled_writer import write_tiled
from service.maps.writer import write_bundle
from tests.unit.lattice import as_tile

COMMAND = [sys.executable, "-c", "from service.cli.main import main; main()", "serve"]
URL = f"s3://{BUCKET}/town"


@pytest.fixture
def store(monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, str]]:
    with s3_server() as environment:
        for key, value in environment.items():
            monkeypatch.setenv(key, value)
        yield environment


def push_version(folder: Path, content_of: Callable[..., BundleContent], encoder: bytes, seed: int) -> str:
    squares = {}
    for number in range(2):
        squares[number, 0] = folder / f"tiles-{seed}" / str(number)
        write_bundle(squares[number, 0], as_tile(content_of(seed=seed + number, encoder=encoder)))
    made = write_tiled(folder / f"town-{seed}", squares, 100.0, name="town")
    push(folder / f"town-{seed}", URL)
    return made.version


def until(true: Callable[[], bool]) -> None:
    end = time.monotonic() + 60
    while not true():
        assert time.monotonic() < end
        time.sleep(0.1)


def test_workers_share_the_cache_and_take_over_a_new_version(
    store: dict[str, str],
    tmp_path: Path,
    content_of: Callable[..., BundleContent],
    encoder_of: Callable[..., bytes],
    parts_of: Callable[..., dict[str, Any]],
) -> None:
    first = push_version(tmp_path, content_of, encoder_of(), 1)
    cache = tmp_path / "cache"
    process = subprocess.Popen(
        [*COMMAND, URL, "--tile-cache", str(cache), "--workers", "2", "--port", "0"],
        text=True,
        env={"PATH": "", "STREETFIX_WATCH_S": "0.5", **store},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    told: list[str] = []
    try:
        url = next(found[1] for line in process.stdout or () if (found := re.search(r"serving at (\S+)", line)))
        reading = threading.Thread(target=lambda: told.extend(process.stderr or ()), daemon=True)
        reading.start()

        def version() -> str:
            answer = httpx.post(f"{url}/v1/localize", files=parts_of(), timeout=30)
            assert answer.status_code == 200, answer.text
            return str(answer.json()["map"]["version"])

        assert version() == first
        second = push_version(tmp_path, content_of, encoder_of(), 5)
        until(lambda: version() == second)
        worker = min(descendants(process.pid) - {process.pid})
        os.kill(worker, signal.SIGKILL)  # the next one opens the versions from the cache
        until(lambda: len(descendants(process.pid) - {process.pid} - {worker}) == 2)
        assert {version() for _ in range(10)} == {second}
        assert not [each for each in cache.rglob("*") if each.name.endswith((".partial", ".deleted"))]
    finally:
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == 0
    reading.join(10)
    for stream in (process.stdout, process.stderr):
        assert stream is not None
        stream.close()
    assert CREDENTIALS["AWS_SECRET_ACCESS_KEY"] not in "".join(told)


def test_a_store_that_does_not_answer_is_one_line(tmp_path: Path) -> None:
    """The port of no service."""
    ended = subprocess.run(
        [*COMMAND, URL, "--tile-cache", str(tmp_path / "cache"), "--port", "0"],
        text=True,
        env={"PATH": "", **CREDENTIALS, "AWS_ENDPOINT_URL": "http://127.0.0.1:9", "AWS_ALLOW_HTTP": "true"},
        capture_output=True,
        timeout=120,
    )
    assert ended.returncode == 1
    assert f"{URL}/manifest.json cannot be read" in ended.stderr
    assert "Traceback" not in ended.stderr
    assert CREDENTIALS["AWS_SECRET_ACCESS_KEY"] not in ended.stderr
