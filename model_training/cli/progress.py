"""Progress bars of long commands, on stderr."""

from collections.abc import Iterator
from contextlib import contextmanager
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


class Report(Protocol):
    """Told the stage, how much of it is done, of how much."""

    def __call__(self, stage: str, done: int, total: int, /) -> None:
        """Move the stage's bar."""

    def describe(self, stage: str, text: str, /) -> None:
        """Write something else than its name beside the stage's bar."""


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


@contextmanager
def bars() -> Iterator[Report]:
    """A bar for each stage that is reported."""
    columns = (
        TextColumn("{task.description:24}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True)) as progress:
        yield _Bars(progress)
