"""A job: independent tasks, each of which a process of its own does. This file has what all engines have in common."""

import time
import traceback
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

from service import errors
from service.errors import StreetfixError

#: A task. It can be pickled.
T = TypeVar("T")
#: Progress callback: finished share of a task, 0 to 1.
Share = Callable[[float], None]
#: Error of a task that can be sent to another process: class, message, field. A class that is no error of Streetfix has a traceback as its
#: message.
Failure = tuple[str, str, str]

#: Time between two reports of a task's progress, seconds.
EVERY_S = 0.5


@dataclass(frozen=True, slots=True)
class Job(Generic[T]):
    """Independent tasks, and how they are done.

    Attributes:
        tasks: the tasks. Each can be pickled.
        order: indices of the tasks in the order in which they start.
        do: does a task, and may report its finished share. Other processes import it by its name. It runs again if its process dies, so an
            unfinished task must not disturb the next attempt.
        name_of: returns the name of a task in messages.
        memory_of: returns the memory that a process needs for a task, bytes.
        after_death: what happens to a task whose process died, for the warning.
        remedy: what helps if processes die or the memory is full, for the error.
        error: class of this error.
        on_done: called with the index of each finished task.
        warn: called with a line of text if a process dies.
        on_progress: called with the index and the finished share of a task, if ``do`` reports it.
    """

    tasks: Sequence[T]
    order: Sequence[int]
    do: Callable[[T, Share], None]
    name_of: Callable[[T], str]
    memory_of: Callable[[T], int]
    after_death: str
    remedy: str
    error: type[StreetfixError]
    on_done: Callable[[int], None]
    warn: Callable[[str], None]
    on_progress: Callable[[int, float], None] = lambda *_: None


@dataclass(frozen=True, slots=True)
class Attempt:
    """One start of a task.

    Attributes:
        index: index of the task.
        number: 1 for its first start.
    """

    index: int
    number: int


class Waiting(Generic[T]):
    """The tasks of a job that wait for a process. It decides what follows from the end of a process.

    Args:
        job: the job.
        most_attempts: how often a task is started before the job gives up, if its process dies.
    """

    def __init__(self, job: Job[T], most_attempts: int) -> None:
        self._job, self._most = job, most_attempts
        self._attempts = deque(Attempt(index, 1) for index in job.order)

    def __len__(self) -> int:
        return len(self._attempts)

    def take(self) -> Attempt:
        """Remove the next attempt and return it."""
        return self._attempts.popleft()

    def ended(self, attempt: Attempt, failure: Failure | None) -> None:
        """Report a finished task, or raise the error of a failed one.

        Args:
            attempt: the attempt that ended.
            failure: its error; None if the task is done.

        Raises:
            StreetfixError: the task failed with this error, or the memory was full.
            RuntimeError: the task failed with another error.
        """
        if failure is None:
            self._job.on_done(attempt.index)
            return
        (kind, message, field), name = failure, self._name(attempt)
        found = getattr(errors, kind, None)
        if isinstance(found, type) and issubclass(found, StreetfixError):
            raise found(message, field=field)
        if kind == "MemoryError":
            raise self._job.error(f"{name}: the memory is full; {self._job.remedy}", field="workers")
        raise RuntimeError(f"{name} failed:\n{message}")

    def died(self, attempt: Attempt, how: str) -> None:
        """Report a process that died. Its task is the next that starts.

        Args:
            attempt: the attempt that ended.
            how: how the process ended, for the message.

        Raises:
            StreetfixError: the task has no attempt left.
        """
        name = self._name(attempt)
        if attempt.number >= self._most:
            raise self._job.error(
                f"{name}: its process {how} in each of {self._most} attempts; {self._job.remedy}", field="workers"
            )
        self._job.warn(f"{name}: its process {how}; {self._job.after_death}")
        self._attempts.appendleft(Attempt(attempt.index, attempt.number + 1))

    def _name(self, attempt: Attempt) -> str:
        return self._job.name_of(self._job.tasks[attempt.index])


def failure_of(do: Callable[[T, Share], None], task: T, on_progress: Share) -> Failure | None:
    """Do a task in this process. Return the error if it failed.

    Args:
        do: does the task.
        task: the task.
        on_progress: called with the finished share, at most twice per second.
    """
    last_s = -EVERY_S

    def share(finished: float) -> None:
        nonlocal last_s
        if time.monotonic() - last_s >= EVERY_S:
            last_s = time.monotonic()
            on_progress(finished)

    try:
        do(task, share)
    except StreetfixError as error:
        return type(error).__name__, error.message, error.field
    except Exception as error:  # the other process raises it again
        return type(error).__name__, traceback.format_exc(), ""
    return None
