"""Report the progress of long commands on stderr: bars on a terminal, else lines per minute and per stage."""

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Protocol

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

#: Time between two lines of a stage without a terminal, seconds.
EVERY_S = 60.0


class Report(Protocol):
    """Progress callback."""

    def __call__(self, stage: str, done: int, total: int, /) -> None:
        """Report progress.

        Args:
            stage: name of the stage.
            done: finished units of work.
            total: all units of work of the stage.
        """

    def describe(self, stage: str, text: str, /) -> None:
        """Show a text for a stage.

        Args:
            stage: name of a stage that was reported.
            text: replaces the name of the stage at its bar; lines show it after the name.
        """


class _Silent:
    def __call__(self, stage: str, done: int, total: int, /) -> None:
        pass

    def describe(self, stage: str, text: str, /) -> None:
        pass


#: Reports nothing: for processes whose progress another process shows.
SILENT: Report = _Silent()


class _Bars:
    def __init__(self, progress: Progress) -> None:
        self._progress = progress
        self._tasks: dict[str, TaskID] = {}

    def __call__(self, stage: str, done: int, total: int, /) -> None:
        if stage not in self._tasks:
            self._tasks[stage] = self._progress.add_task(stage, total=total)
        self._progress.update(self._tasks[stage], completed=done, total=total)

    def describe(self, stage: str, text: str, /) -> None:
        self._progress.update(self._tasks[stage], description=text)


@dataclass(slots=True)
class _Stage:
    """State of a stage.

    Attributes:
        began_s: time of its first report, seconds.
        first: units that were already done then, because a build resumes.
        done: finished units.
        total: all units.
        text: text of ``describe``.
        told_end: whether the line for its end is written.
    """

    began_s: float
    first: int
    done: int
    total: int
    text: str = ""
    told_end: bool = False


class Lines:
    """Report progress in lines: at the start of a stage, once per minute, and at its end.

    Args:
        write: function that writes a line; the line has no line break.
        clock: function that returns monotonic seconds.
        every_s: time between two lines of a running stage, seconds.
    """

    def __init__(
        self, write: Callable[[str], None], *, clock: Callable[[], float] = time.monotonic, every_s: float = EVERY_S
    ) -> None:
        self._write, self._clock, self._every_s = write, clock, every_s
        self._stages: dict[str, _Stage] = {}
        self._current: str | None = None
        self._told_s = clock()
        self._lock = threading.Lock()

    def __call__(self, stage: str, done: int, total: int, /) -> None:
        """Store the progress, and write a line if one is due.

        Args:
            stage: name of the stage.
            done: finished units of work.
            total: all units of work of the stage.
        """
        with self._lock:
            if stage != self._current:
                self._end_current()
                self._current = stage
            known = self._stages.get(stage)
            if known is None or done < known.done:  # less than before: the same work on something else
                self._stages[stage] = _Stage(self._clock(), done, done, total)
                self._tell(f"{stage}: {_share(done, total)}, started")
            else:
                known.done, known.total = done, total
            self._tell_if_due()

    def describe(self, stage: str, text: str, /) -> None:
        """Store a text for the next lines of a stage.

        Args:
            stage: name of a stage that was reported.
            text: shown after the name of the stage.
        """
        with self._lock:
            self._stages[stage].text = text

    def tick(self) -> None:
        """Write a line if the last one is ``every_s`` old, so that a stage with rare reports does not seem to hang."""
        with self._lock:
            self._tell_if_due()

    def close(self) -> None:
        """Write the line for the end of the last stage."""
        with self._lock:
            self._end_current()

    def _tell_if_due(self) -> None:
        if self._current is not None and self._clock() - self._told_s >= self._every_s:
            self._tell(self._line(self._current, self._stages[self._current]))

    def _end_current(self) -> None:
        stage = self._stages.get(self._current or "")
        if stage is not None and stage.done >= stage.total and not stage.told_end:
            stage.told_end = True
            self._tell(f"{self._current}: {stage.done:,} done in {_span(self._clock() - stage.began_s)}")

    def _tell(self, line: str) -> None:
        self._told_s = self._clock()
        self._write(line)

    def _line(self, name: str, stage: _Stage) -> str:
        elapsed_s, parts = self._clock() - stage.began_s, [f"{name}: {_share(stage.done, stage.total)}"]
        parts += [stage.text] if stage.text else []
        rate = (stage.done - stage.first) / elapsed_s if elapsed_s > 0 else 0.0
        if rate > 0:
            parts.append(f"{rate:.3g} per second" if rate >= 1 else f"{60 * rate:.3g} per minute")
        parts.append(f"{_span(elapsed_s)} elapsed")
        if rate > 0 and stage.done < stage.total:
            parts.append(f"about {_span((stage.total - stage.done) / rate)} left")
        return ", ".join(parts)


def _share(done: int, total: int) -> str:
    return f"{done:,} of {total:,} ({100 * done / total:.0f} %)" if done < total else f"{done:,}"


def _span(seconds: float) -> str:
    """Format a time, such as 40 s, 12 min or 2 h 10 min."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60} h {minutes % 60} min"


@contextmanager
def lines(write: Callable[[str], None], *, every_s: float = EVERY_S) -> Iterator[Lines]:
    """Provide ``Lines`` that also write if no report comes for a long time.

    Args:
        write: function that writes a line.
        every_s: time between two lines of a running stage, seconds.
    """
    shown, ended = Lines(write, every_s=every_s), threading.Event()

    def watch() -> None:
        while not ended.wait(every_s):
            shown.tick()

    watcher = threading.Thread(target=watch, name="progress", daemon=True)
    watcher.start()
    try:
        yield shown
        shown.close()
    finally:
        ended.set()
        watcher.join()


def _to_stderr(line: str) -> None:
    with suppress(BrokenPipeError):  # nobody reads it any more; the work goes on
        sys.stderr.write(f"{line}\n")
        sys.stderr.flush()


@contextmanager
def bars() -> Iterator[Report]:
    """Provide one bar per reported stage, or lines if stderr is not a terminal that can draw bars."""
    console = Console(stderr=True)
    if not console.is_terminal or console.is_dumb_terminal:
        with lines(_to_stderr) as shown:
            yield shown
        return
    columns = (
        TextColumn("{task.description:24}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console) as progress:
        yield _Bars(progress)
