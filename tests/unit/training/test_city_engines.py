"""City archives appear complete or not at all, once each, whatever dies meanwhile."""

import multiprocessing
import pickle
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

import service
from model_training.training import city_engines, city_task
from model_training.training.archive_places import FolderOfArchives, StoredArchives, archives_at
from model_training.training.archive_reader import unpack_archive
from model_training.training.city_archive import archive_name
from model_training.training.city_engines import simulate_archives
from model_training.training.city_task import CityTask, code_of_cities, make_archive
from model_training.training.packs import PackPlan, make_pack
from service.errors import DatasetError, ExtraMissingError

PLAN = PackPlan(seed=1002, places=4, queries_a_place=1, lidar="vlp_16", size_m=(60.0, 60.0))
OTHER = replace(PLAN, seed=1003)
NAME, OTHER_NAME = archive_name(PLAN), archive_name(OTHER)


def files_of(folder):
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


@pytest.fixture(scope="module")
def made(grid, tmp_path_factory):
    """Return the files that a simulation in this process writes."""
    folder = FolderOfArchives(tmp_path_factory.mktemp("made"))
    for plan in (PLAN, OTHER):
        make_archive(CityTask(plan, grid, folder, "run", code_of_cities()))
    return files_of(folder.folder)


@pytest.fixture
def task(grid, tmp_path):
    return CityTask(PLAN, grid, FolderOfArchives(tmp_path), "run", code_of_cities())


@pytest.fixture
def quick(monkeypatch):
    """Replace the simulation by one that writes nothing but the archive."""
    monkeypatch.setattr(city_task, "make_pack", lambda *_: None)
    monkeypatch.setattr(city_task, "write_archive", lambda _pack, plan, _grid, target: target.write_text(plan.stem))


@pytest.fixture
def serial(monkeypatch):
    """Run the tasks in this process."""

    def run(_engine, job, _workers, **_):
        for index in job.order:
            job.do(job.tasks[index], lambda _: None)
            job.on_done(index)

    monkeypatch.setattr(city_engines, "run_job", run)


class Killer:
    """Kill the first processes that start, from a thread."""

    def __init__(self, most: int) -> None:
        self._most, self._ended, self.killed = most, threading.Event(), set[int | None]()
        self._thread = threading.Thread(target=self._watch)

    def _watch(self) -> None:
        while not self._ended.wait(0.01):
            for process in multiprocessing.active_children():
                if process.pid not in self.killed and len(self.killed) < self._most:
                    self.killed.add(process.pid)
                    process.kill()

    def __enter__(self) -> "Killer":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()


def test_an_archive_holds_the_simulated_pack(made, grid, tmp_path):
    (tmp_path / NAME).write_bytes(made[NAME])
    unpack_archive(tmp_path / NAME, PLAN, grid, tmp_path / "unpacked")
    make_pack(PLAN, tmp_path / "pack", grid)
    assert files_of(tmp_path / "unpacked") == files_of(tmp_path / "pack")


def test_processes_give_the_same_bytes_although_one_is_killed(made, grid, tmp_path):
    told, warned = [], []
    with Killer(1) as killer:
        simulate_archives(
            [PLAN, OTHER],
            FolderOfArchives(tmp_path),
            grid,
            workers=2,
            report=lambda *event: told.append(event),
            warn=warned.append,
        )
    assert files_of(tmp_path) == made
    assert told == [("training cities", done, 2) for done in range(3)]
    assert len(killer.killed) == len(warned) == 1
    assert (
        "its process was killed by SIGKILL (is the memory full?); another process simulates the city again" in warned[0]
    )


def test_a_city_whose_processes_all_die_stops_the_command(grid, tmp_path):
    with (
        Killer(9),
        pytest.raises(DatasetError, match=r"was killed by SIGKILL .* in each of 2 attempts; give fewer --workers"),
    ):
        simulate_archives([PLAN], FolderOfArchives(tmp_path), grid, workers=1)
    assert list(tmp_path.iterdir()) == []
    assert multiprocessing.active_children() == []


def test_ctrl_c_keeps_finished_cities_and_leaves_no_process(made, grid, tmp_path):
    def interrupt(_stage, done, _total):
        if done:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate_archives([PLAN, OTHER], FolderOfArchives(tmp_path), grid, workers=1, report=interrupt)
    assert multiprocessing.active_children() == []
    assert files_of(tmp_path) == {NAME: made[NAME]}


def test_the_next_command_makes_only_what_is_missing(grid, quick, serial, tmp_path):
    told = []
    (tmp_path / NAME).write_text("kept")
    (tmp_path / f".{NAME}.before-1234.part").mkdir()  # of a process that was killed after it had published the archive
    simulate_archives([PLAN, OTHER], FolderOfArchives(tmp_path), grid, report=lambda *event: told.append(event))
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {NAME: "kept", OTHER_NAME: OTHER.stem}
    assert told == [("training cities", 1, 2), ("training cities", 2, 2)]
    simulate_archives([PLAN, OTHER], FolderOfArchives(tmp_path), grid, report=lambda *event: told.append(event))
    assert told[2:] == [("training cities", 2, 2)]


def test_remains_of_killed_processes_go_with_the_archive(task, quick, tmp_path):
    for name in (f".{NAME}.before-1234.part", f".{NAME}.run-5678.part", f".{OTHER_NAME}.before-1234.part"):
        (tmp_path / name).mkdir()
    task.place.clear(NAME, "run")
    assert {path.name for path in tmp_path.iterdir()} == {
        f".{NAME}.before-1234.part",
        f".{OTHER_NAME}.before-1234.part",
    }
    make_archive(task)
    assert {path.name for path in tmp_path.iterdir()} == {NAME, f".{OTHER_NAME}.before-1234.part"}


def test_a_simulation_that_fails_leaves_nothing(task, quick, monkeypatch, tmp_path):
    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(city_task, "write_archive", fail)
    with pytest.raises(
        DatasetError, match=r"\.tar: the archive cannot be written \(No space left on device\).*another --out"
    ):
        make_archive(task)
    assert list(tmp_path.iterdir()) == []


def test_another_process_may_publish_the_same_archive_first(task, quick, monkeypatch, tmp_path):
    def publish(*_):
        (tmp_path / NAME).write_text("of the other process")
        raise FileNotFoundError(2, "the other process removed it")

    monkeypatch.setattr(city_task, "write_archive", publish)
    make_archive(task)
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {NAME: "of the other process"}


def test_a_process_of_another_release_refuses_the_task(task, tmp_path):
    assert task.code == code_of_cities()
    with pytest.raises(
        DatasetError, match="another build of streetfix, or another release of opencv, numpy, scipy, shapely or embreex"
    ):
        make_archive(replace(task, code="another"))
    assert list(tmp_path.iterdir()) == []


def test_all_code_that_makes_a_pack_decides_whether_two_processes_agree():
    """What packs load besides has no influence: readers of files, errors, and the registration, of which they take a constant."""
    program = "import sys, model_training.training.packs; print(*(getattr(m, '__file__', None) for m in sys.modules.values()), sep='\\n')"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    root = Path(service.__path__[0]).parent
    # The environment of a clone may lie in its folder.
    loaded = {Path(name) for name in done.stdout.splitlines() if name.endswith(".py") and "site-packages" not in name}
    left = {path.relative_to(root).as_posix() for path in loaded - {*city_task._files()} if path.is_relative_to(root)}
    assert {name for name in left if not name.endswith("__init__.py")} == {
        "model_training/datasets/files.py",
        "service/compiled.py",
        "service/errors.py",
        "service/platforms.py",
        "service/registration/kernel.py",
    }
    assert {"stereo.py", "scene.py", "_level.so", "_resample.so"} <= {path.name for path in city_task._files()}


def test_the_memory_grows_with_the_arrays_of_the_city(task):
    """A place of 16 x 256 cells has 3 bytes a cell, and its query of 16 x 32 cells has 5."""
    assert task.memory_bytes - city_task.PROCESS_BYTES == 2 * 4 * (16 * 256 * 3 + 16 * 32 * 5)


def test_engines_that_cannot_run_are_refused_before_the_work(grid, monkeypatch, tmp_path):
    with pytest.raises(DatasetError, match="workers: 0 is not valid; give 1 or more"):
        simulate_archives([PLAN], FolderOfArchives(tmp_path / "out"), grid, workers=0)
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ExtraMissingError, match=r"--engine ray needs the package 'ray': .*\[ray\]"):
        simulate_archives([PLAN], FolderOfArchives(tmp_path / "out"), grid, engine="ray")
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def in_store(tmp_path) -> Callable[[], dict[str, bytes]]:
    return lambda: files_of(tmp_path / "store")


def test_archives_may_lie_in_object_storage(grid, quick, serial, tmp_path, in_store):
    place = archives_at(f"file://{tmp_path}/store")
    assert isinstance(place, StoredArchives)
    simulate_archives([PLAN, OTHER], pickle.loads(pickle.dumps(place)), grid)  # noqa: S301  # as a task of Ray gets it
    assert in_store() == {NAME: PLAN.stem.encode(), OTHER_NAME: OTHER.stem.encode()}
    assert place.full_name(NAME) == f"file://{tmp_path}/store/{NAME}"
    assert place.fetched(NAME, tmp_path).read_text() == PLAN.stem
    with pytest.raises(DatasetError, match=r"store/none\.tar is missing in the store; simulate them there"):
        place.fetched("none.tar", tmp_path)


def test_what_killed_processes_left_of_a_stored_archive_goes_with_their_command(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    place = archives_at(f"file://{tmp_path}/store")
    killed = [place.scratch(NAME, run) for run in ("first", "second")]  # never left
    first, second = [scratch.__enter__() for scratch in killed]
    assert sorted(tmp_path.iterdir()) == sorted([first, second])
    place.clear(NAME)  # another command may be making it for another store
    place.clear(OTHER_NAME, "first")
    assert sorted(tmp_path.iterdir()) == sorted([first, second])
    place.clear(NAME, "first")
    assert list(tmp_path.iterdir()) == [second]


def test_a_folder_is_absolute_so_that_processes_in_other_folders_find_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert archives_at("cities") == FolderOfArchives(tmp_path / "cities")
