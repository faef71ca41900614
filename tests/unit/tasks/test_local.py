"""Tasks in processes of this machine, some of which die."""

import multiprocessing
import signal
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import pytest

from model_training.tasks import local
from model_training.tasks.job import Job
from model_training.tasks.local import _free_bytes, _how, run_local, workers_that_fit
from service.errors import BundleError, DatasetError


@pytest.fixture(autouse=True)
def processes_find_the_tasks(monkeypatch):
    """A process gets the module path of its parent. In it, the package ``tests`` may be another one."""
    monkeypatch.syspath_prepend(str(Path(__file__).parent))


def work(name, folder, **how):
    return import_module("dying_work").Work(name, folder, **how)


def job_of(*tasks, order=None, on_done=lambda _: None):
    """Return a job, and what it reports."""
    told = SimpleNamespace(done=[], progress=[], warned=[])

    def done(index):
        told.done.append(index)
        on_done(index)

    job = Job(
        tasks,
        order=order or range(len(tasks)),
        do=import_module("dying_work").do,
        name_of=lambda task: task.name,
        memory_of=lambda _: 1,
        after_death="it starts again",
        remedy="use less",
        error=DatasetError,
        on_done=done,
        warn=told.warned.append,
        on_progress=lambda *event: told.progress.append(event),
    )
    return job, told


def test_a_task_whose_process_is_killed_starts_again_before_the_others(tmp_path):
    job, told = job_of(work("a", tmp_path), work("b", tmp_path, deaths=1), work("c", tmp_path), order=[1, 2, 0])
    run_local(job, 1)
    assert (tmp_path / "order").read_text() == "bbca"
    assert told.done == [1, 2, 0]
    assert told.progress == [(index, 0.25) for index in (1, 1, 2, 0)]
    assert told.warned == ["b: its process was killed by SIGKILL (is the memory full?); it starts again"]


def test_a_task_whose_processes_all_die_stops_the_others(tmp_path):
    job, told = job_of(work("a", tmp_path, lasts_s=600.0), work("b", tmp_path, deaths=9))
    with pytest.raises(
        DatasetError, match=r"^b: its process was killed by SIGKILL .* in each of 2 attempts; use less$"
    ):
        run_local(job, 2)
    assert multiprocessing.active_children() == []
    assert told.done == []


def test_an_error_of_a_task_stops_the_others(tmp_path):
    job, told = job_of(work("a", tmp_path, lasts_s=600.0), work("b", tmp_path, fails=True))
    with pytest.raises(BundleError, match=r"^the store is full$") as raised:
        run_local(job, 2)
    assert raised.value.field == "out"
    assert multiprocessing.active_children() == []
    assert told.warned == []


def test_ctrl_c_leaves_no_process(tmp_path):
    def interrupt(_):
        raise KeyboardInterrupt

    job, told = job_of(work("a", tmp_path, lasts_s=600.0), work("b", tmp_path), on_done=interrupt)
    with pytest.raises(KeyboardInterrupt):
        run_local(job, 2)
    assert multiprocessing.active_children() == []
    assert told.done == [1]


def test_the_end_of_a_process_is_told():
    assert _how(3) == "ended with code 3"
    assert _how(-signal.SIGTERM) == "was killed by SIGTERM"


@pytest.mark.parametrize(("free", "cores", "expected"), [(10, 8, 1), (30, 8, 1), (50, 8, 2), (999, 8, 3), (999, 2, 2)])
def test_cores_memory_and_tasks_limit_the_number_of_processes(monkeypatch, free, cores, expected):
    """The largest of three tasks takes 20 bytes."""
    monkeypatch.setattr(local, "_cores", lambda: cores)
    monkeypatch.setattr(local, "_free_bytes", lambda: free)
    job, _ = job_of(10, 20, 20)
    assert workers_that_fit(replace(job, memory_of=lambda task: task)) == expected


def test_free_memory_is_that_of_the_machine_or_of_the_control_group(tmp_path):
    meminfo = tmp_path / "meminfo"
    meminfo.write_text("MemTotal: 9000000 kB\nMemAvailable:   1000000 kB\n")
    assert _free_bytes(meminfo, tmp_path) == 1000000 << 10
    (tmp_path / "memory.max").write_text("700000000\n")
    (tmp_path / "memory.current").write_text("200000000\n")
    assert _free_bytes(meminfo, tmp_path) == 500000000
    (tmp_path / "memory.max").write_text("max\n")
    assert _free_bytes(meminfo, tmp_path) == 1000000 << 10
