"""Swaps, signals and hostile clients while others ask: whoever behaves gets an answer."""

import re
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
import zlib
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import pytest

from service.maps.content import BundleContent
from service.maps.writer import write_bundle

COMMAND = [sys.executable, "-c", "from service.cli.main import main; main()"]
Parts = Callable[..., dict[str, bytes]]


class Service:
    """The real command on a folder of maps."""

    def __init__(self, folder: Path, **settings: object) -> None:
        environment = {f"STREETFIX_{name.upper()}": str(value) for name, value in settings.items()}
        self.process = subprocess.Popen(
            [*COMMAND, "serve", str(folder), "--threads", "2", "--port", "0"],
            env={"PATH": "", **environment},
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self.process.stdout is not None
        self.url = next(found[1] for line in self.process.stdout if (found := re.search(r"serving at (\S+)", line)))

    def stop(self) -> None:
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
        self.process.communicate(timeout=60)


@pytest.fixture
def folder(content_of: Callable[..., BundleContent], tmp_path: Path) -> Path:
    write_bundle(tmp_path / "maps" / "v0", content_of(seed=0))
    return tmp_path / "maps"


@pytest.fixture
def start(folder: Path) -> Iterator[Callable[..., Service]]:
    running: list[Service] = []

    def begin(**settings: object) -> Service:
        running.append(Service(folder, **settings))
        return running[-1]

    yield begin
    for service in running:
        service.stop()


def post(client: httpx.Client, parts: dict[str, bytes]) -> httpx.Response:
    return client.post("/v1/localize", files={name: (name, data) for name, data in parts.items()})


def test_no_request_fails_while_maps_are_swapped(
    start: Any, folder: Path, content_of: Callable[..., BundleContent], parts_of: Parts
) -> None:
    service, parts, done = start(), parts_of(), threading.Event()

    def ask() -> list[tuple[int, str]]:
        found = []
        with httpx.Client(base_url=service.url, timeout=30) as client:
            while not done.is_set():
                answer = post(client, parts)
                found.append((answer.status_code, answer.json()["map"]["version"]))
        return found

    with ThreadPoolExecutor(2) as pool:
        asking = [pool.submit(ask) for _ in range(2)]
        served = []
        for seed in range(1, 6):
            write_bundle(folder / f"v{seed}", content_of(seed=seed))
            service.process.send_signal(signal.SIGHUP)
            served.append(_newest(service.url, served))
        done.set()
        answers = [each for future in asking for each in future.result()]
    assert {status for status, _ in answers} == {200}
    assert {version for _, version in answers} & set(served)  # how many of them met a request is a matter of time
    assert len(answers) > 10


def _newest(url: str, before: list[str]) -> str:
    until = time.monotonic() + 30
    with httpx.Client(base_url=url) as client:
        while True:
            (entry,) = client.get("/v1/maps").json()["maps"]
            if entry["version"] not in before and len(entry["versions"]) > 1:
                return str(entry["version"])
            assert time.monotonic() < until
            time.sleep(0.02)


def test_what_was_asked_before_sigterm_is_answered(start: Any, parts_of: Parts) -> None:
    service, parts = start(), parts_of()

    def ask(_: int) -> int:
        with httpx.Client(base_url=service.url, timeout=30) as client:
            return post(client, parts).status_code

    with ThreadPoolExecutor(12) as pool:
        asking = [pool.submit(ask, k) for k in range(12)]
        next(future for future in asking if future.result() == 200)
        _until_asked(service.url)
        service.process.send_signal(signal.SIGTERM)
        assert {future.result() for future in asking} == {200}
    assert service.process.wait(30) == 0


def _until_asked(url: str) -> None:
    """All connections are accepted: a request that comes after them is answered."""
    assert httpx.get(f"{url}/livez", timeout=30).status_code == 200


def test_a_service_that_leaves_says_so_first_and_still_answers(start: Any, parts_of: Parts) -> None:
    service = start(drain_s=3)
    with httpx.Client(base_url=service.url, timeout=30) as client:
        assert client.get("/readyz").status_code == 200
        service.process.send_signal(signal.SIGTERM)
        until = time.monotonic() + 2.5
        while (ready := client.get("/readyz")).status_code == 200:
            assert time.monotonic() < until
        assert (ready.status_code, ready.json()["code"]) == (503, "not-ready")
        assert "stopping" in ready.json()["detail"]
        assert client.get("/livez").status_code == 200
        assert post(client, parts_of()).status_code == 200
    assert service.process.wait(30) == 0


def png_of(width: int, height: int) -> bytes:
    """A picture of so many pixels in some kilobytes: a bomb, where the pixels are many."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    rows = zlib.compress(bytes(min(height, 4000) * (width + 1)), 9)
    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def hostile(parts: dict[str, bytes]) -> dict[str, tuple[dict[str, bytes], set[int]]]:
    """Requests of bad will, and what they may get."""
    return {
        "a picture that would be gigabytes": (parts | {"rgb": png_of(30_000, 30_000)}, {413}),
        "a depth that would be gigabytes": (parts | {"depth": png_of(30_000, 30_000)}, {413, 415, 422}),
        "a thousand parts": (parts | {f"more{k}": b"x" for k in range(1000)}, {413}),
        "deep JSON": (parts | {"request": b'{"camera":' * 50_000}, {422}),
        "a number of a million digits": (parts | {"request": b'{"camera": ' + b"9" * 1_000_000 + b"}"}, {422}),
        "an endless zstd frame": (parts | {"depth": b"SFD1" + bytes(60)}, {413, 415, 422}),
        "nothing": ({}, {415, 422}),
    }


def test_hostile_requests_are_refused_and_others_are_answered(start: Any, parts_of: Parts) -> None:
    service, parts = start(request_timeout_s=2), parts_of()
    wanted = hostile(parts)

    def attack(name: str) -> tuple[str, int]:
        with httpx.Client(base_url=service.url, timeout=30) as client:
            return name, post(client, wanted[name][0]).status_code

    def slow() -> bytes:
        address = httpx.URL(service.url)
        with socket.create_connection((address.host, address.port or 80), timeout=30) as connection:
            connection.sendall(
                b"POST /v1/localize HTTP/1.1\r\nHost: localhost\r\nContent-Type: multipart/form-data; boundary=b\r\n"
                b"Content-Length: 100000\r\n\r\n--b"
            )
            return connection.recv(100)

    def behave(_: int) -> int:
        with httpx.Client(base_url=service.url, timeout=30) as client:
            return post(client, parts).status_code

    before = _resident_mib(service.process.pid)
    with ThreadPoolExecutor(16) as pool:
        attacks = [pool.submit(attack, name) for name in wanted]
        slow_ones = [pool.submit(slow) for _ in range(4)]
        behaved = [pool.submit(behave, k) for k in range(5)]
        for future in attacks:
            name, status = future.result()
            assert status in wanted[name][1], name
        assert {future.result() for future in behaved} == {200}
        assert {future.result()[:12] for future in slow_ones} == {b"HTTP/1.1 504"}
    assert _resident_mib(service.process.pid) - before < 200


def _resident_mib(pid: int) -> float:
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * 4096 / 2**20
