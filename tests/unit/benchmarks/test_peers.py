import re
import signal
import subprocess
import sys
from contextlib import nullcontext
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from benchmarks.report import Report
from benchmarks.serving.peers import measure, venvs
from benchmarks.serving.peers.hosts import Host
from benchmarks.serving.peers.measure import Figures, measured, require_same, write_rows
from benchmarks.serving.peers.venvs import PIPELINE, REQUIREMENTS, PeerError, python_of
from model_training.loadtest.drive import Shot
from model_training.loadtest.payloads import Payload
from model_training.loadtest.processes import descendants
from model_training.loadtest.targets import Reply
from service.grpc.generated.streetfix.v1 import localization_pb2 as pb

SENT = Payload(b"parts", "multipart/form-data; boundary=x", pb.LocalizeRequest(), None)
#: Answers anything, and has a child that does not listen to SIGTERM.
SERVER = """
import signal, subprocess, sys
from http.server import BaseHTTPRequestHandler, HTTPServer

class Handler(BaseHTTPRequestHandler):
    def do_POST(self):
        self.rfile.read(int(self.headers["Content-Length"]))
        self.send_response(200)
        self.end_headers()

stubborn = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print(1, flush=True); time.sleep(60)"
subprocess.Popen([sys.executable, "-c", stubborn], stdout=subprocess.PIPE).stdout.readline()
signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
HTTPServer(("127.0.0.1", int(sys.argv[-1])), Handler).serve_forever()
"""


def figures(retrieval, full, p99_ms, cpu_ms=10.0):
    return Figures(
        {"retrieval": retrieval, "full": full},
        {"retrieval": [cpu_ms] * len(retrieval), "full": [cpu_ms] * len(full)},
        p99_ms,
        asked=100 * len(p99_ms),
    )


def rows_of(found, failed, *, rounds=3):
    report = Report("serving", "test")
    write_rows(report, found, failed, rounds=rounds)
    return {row["id"]: row for row in report.rows}


def answer(*, street="broadway", x=1.0, status="LOCALIZED"):
    return {"street": {"id": street, "vote": 0.5}, "status": status, "pose": {"position": {"x": x, "y": 2.0, "z": 3.0}}}


@pytest.mark.parametrize("name", REQUIREMENTS)
def test_packages_of_a_peer_are_pinned(name):
    assert all(re.fullmatch(r"[a-z-]+(\[[a-z]+\])?==\d+(\.\d+)+", each) for each in REQUIREMENTS[name])
    assert REQUIREMENTS[name][0].startswith(name)
    assert (Path(measure.__file__).parent / f"{name}_app.py").exists()


def test_the_pipelines_libraries_are_the_versions_that_run_here(tmp_path, monkeypatch):
    commands = []
    monkeypatch.setattr(
        venvs, "uv", lambda *arguments: (tmp_path / "ray").mkdir(exist_ok=True) or commands.append(arguments)
    )
    python_of("ray", tmp_path)
    (installed,) = [each for each in commands if each[0] == "pip"]
    assert {f"{each}=={version(each)}" for each in PIPELINE} < set(installed)
    assert set(REQUIREMENTS["ray"]) < set(installed)
    del commands[:]
    assert python_of("ray", tmp_path) == tmp_path / "ray" / "bin" / "python"
    assert commands == []  # it is as the table says


def test_an_environment_of_another_table_is_made_again(tmp_path, monkeypatch):
    commands = []
    (tmp_path / "ray").mkdir()
    (tmp_path / "ray" / "installed.txt").write_text("ray[serve]==1.0\n")
    monkeypatch.setattr(venvs, "uv", lambda *arguments: commands.append(arguments[0]))
    python_of("ray", tmp_path)
    assert commands == ["venv", "pip"]


def test_a_package_that_cannot_be_installed_is_reported(monkeypatch):
    def fails(command, **_):
        raise subprocess.CalledProcessError(1, command, stderr="no wheel of\n ray for this Python")

    monkeypatch.setattr(subprocess, "run", fails)
    with pytest.raises(PeerError, match="uv pip failed: no wheel of ray for this Python"):
        venvs.uv("pip", "install", "ray")


def test_the_best_is_another_one_for_each_row():
    """Retrieval: A has 50, and the median of own/A is 60/50. Full: B has 25. p99: A, the median of 90/100, 300/100 and 80/100."""
    rows = rows_of(
        {
            "streetfix": figures([60, 66, 54], [26, 26, 26], [90.0, 300.0, 80.0]),
            "litserve": figures([50, 50, 50], [20, 20, 20], [100.0] * 3),
            "bentoml": figures([40, 40, 90], [25, 26, 25], [120.0] * 3),
        },
        {},
    )
    assert rows["peers.throughput_over_best.retrieval"]["value"] == pytest.approx(1.2)
    assert rows["peers.throughput_over_best.retrieval"]["why"] == "the best is LitServe"
    assert rows["peers.throughput_over_best.full"]["value"] == pytest.approx(26 / 25)
    assert rows["peers.throughput_over_best.full"]["why"] == "the best is BentoML"
    assert rows["peers.p99_under_best"]["value"] == pytest.approx(0.9)
    assert all(rows[f"peers.{row}"]["holds"] for row in ("throughput_over_best.full", "p99_under_best"))
    assert rows["peers.bentoml.answers_per_s.retrieval"]["value"] == 40
    assert rows["peers.streetfix.cpu_ms.full"]["value"] == 10
    assert rows["peers.litserve.p99_ms"]["value"] == 100
    assert rows["peers.streetfix.p99_ms"]["value"] == 90
    assert rows["peers.streetfix.p99_ms"]["n"] == 300


def test_a_peer_that_never_ran_has_its_rows_with_the_reason_and_is_not_the_best():
    rows = rows_of(
        {"streetfix": figures([60] * 3, [26] * 3, [90.0] * 3), "bentoml": figures([40] * 3, [25] * 3, [120.0] * 3)},
        {"ray": "the server ended with code 1"},
    )
    own = {name: row for name, row in rows.items() if name.startswith("peers.ray.")}
    assert len(own) == 5
    assert all(row["value"] is None and row["why"] == "the server ended with code 1" for row in own.values())
    assert (
        rows["peers.p99_under_best"]["why"]
        == "the best is BentoML; Ray Serve did not run: the server ended with code 1"
    )


def test_complete_rounds_before_the_failure_of_a_peer_count():
    rows = rows_of(
        {"streetfix": figures([60] * 3, [26] * 3, [90.0] * 3), "ray": figures([80] * 3, [30] * 2, [1.0])},
        {"ray": "it hung"},
    )
    assert rows["peers.throughput_over_best.retrieval"]["value"] == pytest.approx(0.75)
    assert rows["peers.throughput_over_best.full"]["value"] is None
    assert rows["peers.p99_under_best"]["value"] is None
    assert "it hung" in rows["peers.p99_under_best"]["why"]


def test_no_rows_hold_where_no_peer_ran():
    rows = rows_of({"streetfix": figures([60] * 3, [26] * 3, [90.0] * 3)}, {"ray": "no wheel"})
    barred = [row for row in rows.values() if "bar" in row]
    assert len(barred) == 3
    assert not any(row["holds"] for row in barred)


@pytest.mark.parametrize(
    ("other", "said"),
    [
        (answer(street="elm"), "street"),
        (answer(status="AMBIGUOUS"), "status"),
        (answer(x=1.00001), "1e-05 m"),
        (answer(x=float("nan")), "nan m"),
    ],
)
def test_another_answer_than_streetfixs_is_refused(other, said):
    with pytest.raises(PeerError, match=said):
        require_same([answer(), answer()], [answer(), other])


def test_an_answer_that_differs_by_rounding_is_the_same():
    require_same([answer()], [answer(x=1.0 + 1e-9)])
    require_same([answer() | {"street": None}], [answer() | {"street": None}])


@pytest.fixture
def loaded(monkeypatch):
    """Return load runs without waiting: 20 full answers per second, 50 of retrieval, 30 ms each. Record the order of calls."""
    done = []

    def load(server, face, sent, how):
        kind = sent[0]
        done.append((server.name, kind, how.rate, how.seed))
        if server.name == "ray" and how.rate is not None:
            raise ExceptionGroup("load", [PeerError("it is gone")])
        summary = SimpleNamespace(
            answered_per_s={"full": 20.0, "retrieval": 50.0}[kind] / (2 if server.name == "mlserver" else 1),
            cpu_ms_per_answer=9.0,
            errors={"timeout": 1} if server.name == "bentoml" else {},
            inconsistent=0,
        )
        shots = [
            Shot(0.0, 0.0, 9.0, 0, Reply("ok")),
            Shot(how.warm_up_s, how.warm_up_s, how.warm_up_s + 0.03, 0, Reply("ok")),
        ]
        return summary, shots

    monkeypatch.setattr(measure, "load", load)
    monkeypatch.setattr(measure, "ask", lambda url, payload: answer(x=5.0) if url == "wrong" else answer())  # noqa: ARG005
    return done


def start(name):
    if name == "litserve":
        raise PeerError("the server ended with code 2")
    return nullcontext(SimpleNamespace(name=name, url="right"))


SENDING: dict[str, Any] = {"full": ["full"], "retrieval": ["retrieval"]}


def test_all_servers_get_the_same_rate_and_the_same_arrivals(loaded):
    failed = {}
    found, rate = measured(["streetfix", "mlserver"], start, SENDING, failed, seconds=2, rounds=2)
    assert failed == {}
    assert rate == pytest.approx(0.7 * 10)
    assert found["mlserver"].per_s == {"retrieval": [25.0] * 2, "full": [10.0] * 2}
    assert found["mlserver"].p99_ms == pytest.approx([30.0] * 2)
    assert found["mlserver"].asked == 2  # the shot of the warm-up does not count
    assert [each for each in loaded if each[2]] == [
        ("streetfix", "full", rate, 0),
        ("mlserver", "full", rate, 0),
        ("mlserver", "full", rate, 1),
        ("streetfix", "full", rate, 1),
    ]


def test_peers_that_do_not_start_err_or_end_are_left_out_with_their_reasons(loaded):
    failed = {}
    names = ["streetfix", "litserve", "bentoml", "mlserver", "ray"]
    found, _ = measured(names, start, SENDING, failed, seconds=2, rounds=1)
    assert failed == {
        "litserve": "the server ended with code 2",
        "bentoml": "retrieval, saturated: {'timeout': 1}, 0 inconsistent answers",
        "ray": "it is gone",
    }
    assert found["mlserver"].p99_ms
    assert sum(name == "bentoml" for name, *_ in loaded) == 1


def test_a_peer_with_other_answers_is_not_timed(loaded):
    failed = {}

    def start_wrong(name):
        return nullcontext(SimpleNamespace(name=name, url="wrong" if name == "ray" else "right"))

    measured(["streetfix", "ray"], start_wrong, SENDING, failed, seconds=2, rounds=1)
    assert "4 m from Streetfix's" in failed["ray"]
    assert not any(name == "ray" for name, *_ in loaded)


def test_streetfix_failing_ends_the_measurement(loaded):
    def start_none(name):
        raise PeerError(name)

    with pytest.raises(PeerError, match="streetfix"):
        measured(["streetfix", "ray"], start_none, SENDING, {}, seconds=2, rounds=1)


def test_the_whole_tree_of_a_peer_is_stopped():
    with Host([sys.executable, "-c", SERVER], SENT, core=None) as host:
        tree = descendants(host.process.pid)
        assert len(tree) == 2
        assert host.used.resident_mib > 8
    assert host.process.returncode == 0
    assert not any(running(pid) for pid in tree)


def test_a_peer_that_ends_reports_its_last_output():
    with pytest.raises(PeerError, match=r"the server ended with code 3: no such map"):
        Host([sys.executable, "-c", "import sys; print('no such map'); sys.exit(3)"], SENT, core=None)


def test_a_peer_that_never_answers_is_stopped(monkeypatch):
    started = []
    popen = subprocess.Popen
    monkeypatch.setattr(subprocess, "Popen", lambda *a, **k: started.append(popen(*a, **k)) or started[-1])
    loading = [sys.executable, "-c", "import time; print('still loading', flush=True); time.sleep(60)"]
    with pytest.raises(PeerError, match=r"no answer within 4 s, the last was ConnectError: still loading"):
        Host(loading, SENT, core=None, patience_s=4.0)
    assert started[0].returncode == -signal.SIGTERM


def running(pid):
    try:
        return (Path("/proc") / str(pid) / "stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
