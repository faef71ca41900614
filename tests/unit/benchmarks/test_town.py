"""The service of the town's rows: its peak memory, its queries, and its end."""

import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import pytest

from benchmarks.report import Report
from benchmarks.scale import town
from benchmarks.serving import machines
from benchmarks.serving.machines import Server, peak_mib
from service.errors import UnavailableError

#: Ends only if it is killed. It says that it serves, and answers that it is ready.
STUBBORN = """
import http.server, signal
signal.signal(signal.SIGTERM, signal.SIG_IGN)
class Ready(http.server.BaseHTTPRequestHandler):
    def do_GET(self):
        self.send_response(200)
        self.send_header("Content-Length", "0")
        self.end_headers()
    def log_message(self, *_):
        pass
server = http.server.HTTPServer(("127.0.0.1", 0), Ready)
print("serving gRPC at 127.0.0.1:1", flush=True)
print(f"serving at http://127.0.0.1:{server.server_address[1]}", flush=True)
server.serve_forever()
"""


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> list[subprocess.Popen[str]]:
    """Start a stubborn program instead of the service; return its processes."""
    processes: list[subprocess.Popen[str]] = []

    def launch(*_: object, **__: object) -> subprocess.Popen[str]:
        command = [sys.executable, "-c", STUBBORN]
        processes.append(subprocess.Popen(command, stdout=subprocess.PIPE, text=True, process_group=0))
        return processes[-1]

    monkeypatch.setattr(machines, "launch", launch)
    return processes


def test_a_measured_service_keeps_its_bytecode(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """An installed service has it on the disk. Without it, each start compiles two hundred modules."""
    given: dict[str, Any] = {}
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")
    monkeypatch.setattr("subprocess.Popen", lambda _, **arguments: given.update(arguments))
    machines.launch(tmp_path, threads=2)
    assert "PYTHONDONTWRITEBYTECODE" not in given["env"]
    assert given["env"]["STREETFIX_THREADS"] == "2"


def test_a_service_that_does_not_stop_is_killed(
    started: list[subprocess.Popen[str]], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(machines, "_STOP_S", 0.1)
    with pytest.raises(subprocess.TimeoutExpired), Server(tmp_path, core=None):
        pass
    assert started[0].poll() is not None


def test_a_service_is_killed_if_its_start_is_interrupted(
    started: list[subprocess.Popen[str]], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("httpx.get", interrupted)
    with pytest.raises(KeyboardInterrupt):
        Server(tmp_path, core=None)
    assert started[0].poll() is not None


def test_the_service_is_ended_after_an_error_of_a_query(
    started: list[subprocess.Popen[str]], monkeypatch: pytest.MonkeyPatch, tmp_path: Path, small_dataset: Any
) -> None:
    def fails(*_: object) -> None:
        raise UnavailableError("no answer")

    monkeypatch.setattr(machines, "_STOP_S", 0.1)
    monkeypatch.setattr(town, "ask", fails)
    report = Report("scale", "make bench-scale")
    with pytest.raises((UnavailableError, subprocess.TimeoutExpired)):
        town.open_rows(report, tmp_path, small_dataset)
    assert started[0].poll() is not None
    assert report.rows == []


def test_the_peak_stays_after_the_memory_is_free() -> None:
    """The program fills 200 MiB and frees them."""
    program = "kept = bytearray(b'1') * (200 << 20); del kept; print('free', flush=True); input()"
    command = [sys.executable, "-c", program]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        process.stdout.readline()
        assert 200 < peak_mib(process.pid) < 260
        assert machines.held(process.pid).resident_mib < 100
        process.communicate("\n")


def test_the_service_is_asked_by_several_clients_without_a_prior(
    stock_map: Path, small_dataset: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The real command with a small map."""
    ended: list[Server] = []

    class Watched(Server):
        def __exit__(self, *error: Any) -> None:
            super().__exit__(*error)
            ended.append(self)

    monkeypatch.setattr(town, "Server", Watched)
    monkeypatch.setattr(town, "LOAD", 3)
    monkeypatch.setattr(town, "STARTS", 2)
    report = Report("scale", "make bench-scale")
    town.open_rows(report, stock_map, small_dataset)
    found = {row["id"]: row for row in report.rows}
    assert found["town.ready_s"]["value"] > 0
    assert found["town.ready_s"]["n"] == 2
    assert found["town.resident_mib"]["value"] > 50
    assert found["town.resident_mib"]["n"] == 3
    assert "3 queries without a prior from 4 clients over REST" in found["town.resident_mib"]["why"]
    assert [server.process.poll() for server in ended] == [0, 0]


@dataclass
class Asked:
    """Stands for the client of the service; it answers with the number of the query."""

    url: str
    calls: list[dict[str, Any]] = field(default_factory=list)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Nothing is open."""

    def localize(self, rgb: bytes, depth: bytes, camera: Any, **about: Any) -> bytes:
        self.calls.append({"depth": depth, "camera": camera, **about})
        return rgb


def test_each_query_is_sent_once_with_its_files(small_dataset: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    client = Asked("http://127.0.0.1:1")
    monkeypatch.setattr(town, "Client", lambda _url: client)
    frames = list(small_dataset.queries("drive1_precise"))
    answers: list[Any] = list(town.ask(client.url, frames, 2))
    assert answers == [frame.rgb_path.read_bytes() for frame in frames]
    assert len(client.calls) == len(frames)
    assert all("prior" not in call for call in client.calls)
    assert {call["depth_scale_m"] for call in client.calls} == {frames[0].camera.depth.scale_m}
    assert client.calls[0]["camera"].fx == frames[0].camera.fx
