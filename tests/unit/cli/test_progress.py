import os
import subprocess
import sys
import threading
from typing import Any

import pytest
from rich.console import Console

from model_training.cli import progress
from model_training.cli.progress import Lines, lines


class Clock:
    def __init__(self):
        self.now = 1000.0

    def __call__(self):
        return self.now


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def told(clock):
    """Collect the lines in a list."""
    written: list[str] = []
    reporter: Any = Lines(written.append, clock=clock)
    reporter.written = written
    return reporter


def test_a_stage_reports_its_start_one_line_per_minute_and_its_end(told, clock):
    for done in range(1, 1801):  # eight a second
        clock.now += 0.125
        told("places", done, 1800)
    told.close()
    assert told.written == [
        "places: 1 of 1,800 (0 %), started",
        "places: 481 of 1,800 (27 %), 8 per second, 60 s elapsed, about 3 min left",
        "places: 961 of 1,800 (53 %), 8 per second, 2 min elapsed, about 2 min left",
        "places: 1,441 of 1,800 (80 %), 8 per second, 3 min elapsed, about 45 s left",
        "places: 1,800 done in 4 min",
    ]


def test_a_silent_stage_is_reported_too(told, clock):
    told("merge", 1, 4)
    clock.now += 59
    told.tick()
    assert len(told.written) == 1
    clock.now += 1
    told.tick()
    clock.now += 30
    told.tick()
    assert told.written[1:] == ["merge: 1 of 4 (25 %), 60 s elapsed"]


def test_work_before_a_resume_is_not_in_the_rate(told, clock):
    told("places", 900, 1000)
    clock.now += 60
    told("places", 910, 1000)
    assert told.written[-1] == "places: 910 of 1,000 (91 %), 10 per minute, 60 s elapsed, about 9 min left"


def test_a_stage_ends_where_the_next_one_begins(told, clock):
    told("survey", 1, 2)
    clock.now += 5
    told("survey", 2, 2)
    told("places", 0, 7)
    assert told.written == ["survey: 1 of 2 (50 %), started", "survey: 2 done in 5 s", "places: 0 of 7 (0 %), started"]


def test_a_total_that_grows_with_what_is_done_makes_no_line_each_time(told, clock):
    for done in range(1, 500):
        told("frames", done, done)
    told.close()
    assert told.written == ["frames: 1, started", "frames: 499 done in 0 s"]


def test_the_same_stage_with_other_input_starts_again(told, clock):
    told("places", 7, 7)
    clock.now += 600
    told("places", 1, 7)
    clock.now += 60
    told("places", 4, 7)
    assert told.written[-2:] == [
        "places: 1 of 7 (14 %), started",
        "places: 4 of 7 (57 %), 3 per minute, 60 s elapsed, about 60 s left",
    ]


def test_a_text_of_the_stage_stands_in_its_lines(told, clock):
    told("training", 1, 10)
    told.describe("training", "loss 2.31")
    clock.now += 60
    told("training", 3, 10)
    assert "training: 3 of 10 (30 %), loss 2.31, 2 per minute" in told.written[-1]


def test_long_durations_are_in_hours(told, clock):
    told("training", 0, 1000)
    clock.now += 8000
    told("training", 500, 1000)
    assert told.written[-1].endswith("2 h 13 min elapsed, about 2 h 13 min left")


def test_the_watching_thread_reports_while_the_work_is_silent_and_ends_with_it():
    seen = threading.Event()

    def write(line):
        if "elapsed" in line:
            seen.set()

    with lines(write, every_s=0.001) as report:
        report("cloud", 0, 1)
        assert seen.wait(30)
    assert not any(thread.name == "progress" for thread in threading.enumerate())


_PROGRAM = """
from model_training.cli.progress import bars
with bars() as report:
    for done in range(3):
        report("places", done + 1, 3)
    report.describe("places", "text")
"""


def test_into_a_pipe_go_lines_without_control_characters():
    environment = {name: value for name, value in os.environ.items() if name not in ("FORCE_COLOR", "TTY_COMPATIBLE")}
    done = subprocess.run([sys.executable, "-c", _PROGRAM], capture_output=True, text=True, check=True, env=environment)
    assert done.stderr.splitlines()[0] == "places: 1 of 3 (33 %), started"
    assert "places: 3 done in" in done.stderr
    assert "\x1b" not in done.stderr
    assert done.stdout == ""


def test_a_terminal_gets_bars(monkeypatch):
    class Terminal(Console):
        is_terminal = True
        is_dumb_terminal = False

    monkeypatch.setattr(progress, "Console", Terminal)
    with progress.bars() as report:
        report("places", 1, 3)
        assert isinstance(report, progress._Bars)


def test_a_closed_reader_does_not_stop_the_work(monkeypatch):
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write, "w") as nobody:
        monkeypatch.setattr(sys, "stderr", nobody)
        progress._to_stderr("a line")
        monkeypatch.undo()
        # What is left in the buffer cannot be written at the end either.
        with pytest.raises(BrokenPipeError):
            nobody.flush()
        os.dup2(os.open(os.devnull, os.O_WRONLY), write)
