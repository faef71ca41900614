"""Runs with a killed process count only if a process was really killed."""

import importlib.util
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from benchmarks.scale import built
from benchmarks.scale.built import Kill, killed_run, processes_with, require_one_version

SLEEPS, ENDS, FAILS = "import time; time.sleep(60)", "pass", "raise SystemExit(3)"
#: Starts a process, and says so if it is killed, as a build does.
WATCHES = (
    "import subprocess, sys; code = subprocess.run([sys.executable, '-c', 'spawn_main = 0; import time; time.sleep(60)']).returncode; "
    "print('tile 0 0: its process was killed by SIGKILL' if code == -9 else 'fine')"
)


@pytest.fixture
def starting(tmp_path: Path) -> Callable[..., Callable[[], subprocess.Popen[bytes]]]:
    """Return a function that starts these programs, one after the other. Their output goes to ``log``."""

    def of(*programs: str) -> Callable[[], subprocess.Popen[bytes]]:
        left = iter(programs)

        def start() -> subprocess.Popen[bytes]:
            with (tmp_path / "log").open("wb") as log:
                return subprocess.Popen([sys.executable, "-u", "-c", next(left)], stdout=log, stderr=log)

        return start

    return of


def whole(pid: int) -> list[int]:
    return [pid]


BUILD = Kill("whole builds", "local", whole, None)


def run(kill: Kill, start: Callable[[], subprocess.Popen[bytes]], folder: Path) -> int:
    return killed_run(kill, start, folder / "log", random.Random(0), (0.0, 0.0))  # noqa: S311  # no secret


def test_a_build_that_is_killed_counts_at_once(starting, tmp_path):
    assert run(BUILD, starting(SLEEPS), tmp_path) == 0


def test_a_build_that_has_ended_does_not_count(starting, tmp_path, monkeypatch):
    """Two builds end by themselves before the moment, and the third is killed."""
    started: list[subprocess.Popen[bytes]] = []
    start = starting(ENDS, ENDS, SLEEPS)

    def waited() -> subprocess.Popen[bytes]:
        started.append(start())
        if len(started) < 3:
            started[-1].wait()
        return started[-1]

    assert run(BUILD, waited, tmp_path) == 2
    assert started[-1].returncode == -signal.SIGKILL


def test_a_build_without_a_victim_is_tried_a_limited_number_of_times(starting, tmp_path, monkeypatch):
    monkeypatch.setattr(built, "TRIES", 3)
    nobody = Kill("tile processes", "local", lambda _build: [], "was killed")
    with pytest.raises(RuntimeError, match="tile processes: nothing was killed in 3 tries"):
        run(nobody, starting(ENDS, ENDS, ENDS), tmp_path)


def test_a_build_that_fails_by_itself_is_an_error(starting, tmp_path):
    nobody = Kill("tile processes", "local", lambda _build: [], "was killed")
    with pytest.raises(RuntimeError, match="the build ended with code 3"):
        run(nobody, starting(FAILS), tmp_path)


def test_a_killed_tile_process_counts_if_the_build_says_so(starting, tmp_path):
    """The victim is the child of the build whose command line has ``spawn_main``."""

    def child(build: int) -> list[int]:
        for _ in range(1000):
            if found := processes_with(build, b"spawn_main = 0; import time"):
                return found
            time.sleep(0.01)
        return []

    tile = Kill("tile processes", "local", child, "was killed by SIGKILL")
    assert run(tile, starting(WATCHES), tmp_path) == 0
    assert "was killed by SIGKILL" in (tmp_path / "log").read_text()


def test_a_build_that_does_not_notice_the_death_does_not_count(starting, tmp_path, monkeypatch):
    """The victim is no process of the build, as if the tile had been finished already."""
    monkeypatch.setattr(built, "TRIES", 1)
    with subprocess.Popen([sys.executable, "-c", SLEEPS]) as stranger:
        tile = Kill("tile processes", "local", lambda _build: [stranger.pid], "was killed by SIGKILL")
        with pytest.raises(RuntimeError, match="nothing was killed in 1 tries"):
            run(tile, starting("import time; time.sleep(0.2)"), tmp_path)
    assert stranger.returncode == -signal.SIGKILL


def test_the_moment_of_a_kill_lies_where_the_build_has_victims(starting, tmp_path):
    """The build has victims at the second and the third look."""
    looks = iter([[], [1], [1, 2]])
    tile = Kill("tile processes", "local", lambda _build: next(looks, []), "was killed")
    first, last = built.window_of(tile, starting("import time; time.sleep(1)")(), tmp_path / "log")
    assert 0 < first < last
    nobody = Kill("tile processes", "local", lambda _build: [], "was killed")
    with pytest.raises(RuntimeError, match="the build had none to kill"):
        built.window_of(nobody, starting(ENDS)(), tmp_path / "log")


def test_without_ray_its_workers_are_not_killed(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda _name: None)
    assert [kill.name for kill in built.kills()] == ["whole builds", "tile processes"]
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: name)
    assert [(kill.name, kill.engine) for kill in built.kills()][2:] == [("Ray workers", "ray")]


def test_engines_whose_maps_differ_are_an_error():
    require_one_version({"local": {"a"}, "ray": {"a"}})
    with pytest.raises(RuntimeError, match=r"different maps \(local: a; ray: a, b\)"):
        require_one_version({"local": {"a"}, "ray": {"b", "a"}})
