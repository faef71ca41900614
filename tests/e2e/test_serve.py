"""The real commands in processes of their own, over real sockets."""

import json
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import httpx
import pytest

COMMAND = [sys.executable, "-c", "from service.cli.main import main; main()"]
Parts = Callable[..., dict[str, bytes]]


def start(*arguments: str) -> tuple["subprocess.Popen[str]", str]:
    """A service on a port that the system chose, and its address once it says so."""
    process = subprocess.Popen([*COMMAND, "serve", *arguments, "--port", "0"], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    for line in process.stdout:
        if found := re.search(r"serving at (http://\S+)", line):
            return process, found[1]
    raise AssertionError(f"the service ended with {process.wait()} and never served")


def stop(process: "subprocess.Popen[str]", number: signal.Signals) -> tuple[int, str]:
    process.send_signal(number)
    rest, _ = process.communicate(timeout=60)
    return process.returncode, rest


@pytest.fixture(scope="module")
def url(bundle_path: Path) -> Iterator[str]:
    process, address = start(str(bundle_path), "--threads", "1")
    yield address
    assert stop(process, signal.SIGTERM) == (0, "stopped\n")


@pytest.fixture
def files(parts_of: Parts, tmp_path: Path) -> list[str]:
    parts = parts_of()
    for name in parts:
        (tmp_path / name).write_bytes(parts[name])
    return ["--rgb", str(tmp_path / "rgb"), "--depth", str(tmp_path / "depth"), "--camera", str(tmp_path / "request")]


def localize(url: str, *arguments: str) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(
        [*COMMAND, "localize", "--url", url, *arguments], capture_output=True, text=True, check=False, timeout=60
    )


def test_the_answer_is_printed_for_people(url: str, files: list[str]) -> None:
    done = localize(url, *files)
    assert (done.returncode, done.stderr) == (0, "")
    assert "End of street 2" in done.stdout
    assert "LOCALIZED" in done.stdout


def test_the_answer_is_printed_for_programs_as_the_service_gave_it(url: str, files: list[str], parts_of: Parts) -> None:
    printed = json.loads(localize(url, *files, "--map", "tiny", "--json").stdout)
    posted = httpx.post(f"{url}/v1/localize", files={name: (name, data) for name, data in parts_of().items()}).json()
    for answer in (printed, posted):
        answer.pop("timings_ms")
    assert printed == posted
    assert printed["neighbours"][0]["place"] == 8


def test_a_problem_is_printed_and_the_command_fails(url: str, files: list[str]) -> None:
    done = localize(url, *files, "--map", "west")
    assert done.returncode == 1
    assert "mounted maps: tiny [field map]" in done.stderr
    assert "Traceback" not in done.stderr


def test_an_oversized_body_is_refused_over_the_socket(url: str) -> None:
    address = httpx.URL(url)
    with socket.create_connection((address.host, address.port or 80), timeout=30) as connection:
        connection.sendall(
            b"POST /v1/localize HTTP/1.1\r\nHost: localhost\r\nContent-Type: multipart/form-data; boundary=X\r\n"
            b"Content-Length: 10000000000\r\n\r\n"
        )
        answer = connection.recv(4096)
    assert answer.startswith(b"HTTP/1.1 413 ")


def test_ctrl_c_ends_the_service_cleanly(bundle_path: Path) -> None:
    process, _ = start(str(bundle_path))
    assert stop(process, signal.SIGINT) == (0, "stopped\n")


def test_a_corrupt_bundle_stops_the_start_with_a_clear_message(bundle_copy: Path) -> None:
    data = bytearray((bundle_copy / "places.npy").read_bytes())
    data[-1] ^= 1
    (bundle_copy / "places.npy").write_bytes(data)
    done = subprocess.run(
        [*COMMAND, "serve", str(bundle_copy)], capture_output=True, text=True, check=False, timeout=60
    )
    assert (done.returncode, done.stdout) == (1, "")
    told = done.stderr.splitlines()[-1]  # the log above it names every bundle that is refused
    assert re.fullmatch(r"streetfix: \S+places\.npy: the hash does not match the manifest; .*", told)
