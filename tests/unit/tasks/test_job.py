"""What all engines do with the end of a task, and with its progress."""

import pickle
from types import SimpleNamespace

import pytest

from model_training.tasks import job as job_module
from model_training.tasks.job import Attempt, Job, Waiting, failure_of
from service.errors import BundleError, DatasetError


@pytest.fixture
def told():
    """Collect what a job reports."""
    return SimpleNamespace(done=[], warned=[])


@pytest.fixture
def job(told):
    """Return a job of three tasks, the letters a to c."""
    return Job(
        "abc",
        order=[2, 0, 1],
        do=lambda *_: None,
        name_of=lambda task: f"letter {task}",
        memory_of=lambda _: 1,
        after_death="it starts again",
        remedy="use less",
        error=DatasetError,
        on_done=told.done.append,
        warn=told.warned.append,
    )


def test_tasks_start_in_their_order_and_are_told_when_they_are_done(job, told):
    waiting = Waiting(job, 2)
    attempts = [waiting.take() for _ in range(len(waiting))]
    assert attempts == [Attempt(2, 1), Attempt(0, 1), Attempt(1, 1)]
    assert not waiting
    waiting.ended(attempts[1], None)
    assert told.done == [0]


def test_a_task_whose_process_died_is_the_next_until_it_has_no_attempt_left(job, told):
    waiting = Waiting(job, 2)
    waiting.died(waiting.take(), "was lost")
    assert told.warned == ["letter c: its process was lost; it starts again"]
    again = waiting.take()
    assert again == Attempt(2, 2)
    with pytest.raises(
        DatasetError, match=r"^letter c: its process was lost in each of 2 attempts; use less$"
    ) as refused:
        waiting.died(again, "was lost")
    assert refused.value.field == "workers"
    assert len(told.warned) == 1
    assert told.done == []


@pytest.mark.parametrize(
    ("raised", "expected", "message", "field"),
    [
        (BundleError("the store is full", field="out"), BundleError, "^the store is full$", "out"),
        (MemoryError(), DatasetError, "^letter a: the memory is full; use less$", "workers"),
        (ZeroDivisionError("a defect"), RuntimeError, r"(?s)^letter a failed:\nTraceback.*a defect", None),
    ],
)
def test_an_error_of_another_process_is_raised_here(job, told, raised, expected, message, field):
    def fail(*_):
        raise raised

    failure = failure_of(fail, "a", lambda _: None)
    with pytest.raises(expected, match=message) as caught:
        Waiting(job, 2).ended(Attempt(0, 1), pickle.loads(pickle.dumps(failure)))  # noqa: S301  # as it comes from the process
    assert getattr(caught.value, "field", None) == field
    assert told.done == []


def test_progress_is_told_at_most_twice_a_second(monkeypatch):
    now, shares = SimpleNamespace(s=0.0), []

    def do(task, share):
        for now.s, finished in task:
            share(finished)

    monkeypatch.setattr(job_module, "time", SimpleNamespace(monotonic=lambda: now.s))
    task = [(0.0, 0.1), (0.25, 0.2), (0.5, 0.3), (0.75, 0.4), (1.5, 0.5)]
    assert failure_of(do, task, shares.append) is None
    assert shares == [0.1, 0.3, 0.5]
