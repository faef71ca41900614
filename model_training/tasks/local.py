"""Do the tasks of a job in processes of this machine."""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Literal

from model_training.tasks.job import Attempt, Failure, Job, Share, T, Waiting, failure_of

#: How often a task is started before the job gives up, if its process dies.
ATTEMPTS = 2


@dataclass(frozen=True, slots=True, eq=False)
class _Running:
    """A process that does a task."""

    attempt: Attempt
    process: BaseProcess
    pipe: Connection


def run_local(job: Job[T], workers: int) -> None:
    """Do each task in a process of its own, so that its memory is free afterwards. At the end, no process is left.

    Args:
        job: the job.
        workers: number of processes at the same time.

    Raises:
        StreetfixError: a task failed, or its process died in every attempt.
        RuntimeError: a task failed with another error.
    """
    waiting = Waiting(job, ATTEMPTS)
    running: list[_Running] = []
    try:
        while waiting or running:
            while waiting and len(running) < workers:
                running.append(_started(job, waiting.take()))
            wait([each.pipe for each in running])
            for each in list(running):
                failure: Failure | Literal["died"] | None = None
                try:
                    if not each.pipe.poll():
                        continue
                    message = each.pipe.recv()
                except EOFError:
                    failure = "died"
                else:
                    if not isinstance(message, tuple):
                        job.on_progress(each.attempt.index, message)
                        continue
                    failure = message[0]
                each.process.join()
                each.pipe.close()
                running.remove(each)
                if failure == "died":
                    waiting.died(each.attempt, _how(each.process.exitcode))
                else:
                    waiting.ended(each.attempt, failure)
    finally:
        for each in running:
            each.process.kill()  # the next attempt expects that
        for each in running:
            each.process.join()
            each.pipe.close()


def _started(job: Job[T], attempt: Attempt) -> _Running:
    context, task = multiprocessing.get_context("spawn"), job.tasks[attempt.index]
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_in_process, args=(sender, job.do, task), name=job.name_of(task), daemon=True)
    process.start()
    sender.close()  # so that the end of the process closes the pipe
    return _Running(attempt, process, receiver)


def _in_process(pipe: Connection, do: Callable[[T, Share], None], task: T) -> None:
    """Do a task and send shares, and at last a tuple of the failure or None."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the parent, which ends its processes
    threading.Thread(target=_end_with_parent, daemon=True).start()
    with suppress(BrokenPipeError):  # the parent has died, and this process ends too
        pipe.send((failure_of(do, task, pipe.send),))


def _end_with_parent() -> None:
    """End this process when its parent has died, so that the next command finds no process at work."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


def _how(exitcode: int | None) -> str:
    if exitcode is not None and exitcode < 0:
        name = signal.Signals(-exitcode).name
        return f"was killed by {name}" + (" (is the memory full?)" if name == "SIGKILL" else "")
    return f"ended with code {exitcode}"


def workers_that_fit(job: Job[T]) -> int:
    """Return a number of processes: one per core, fewer if the largest tasks do not fit into memory side by side.

    Args:
        job: the job, with at least one task.
    """
    largest = max(job.memory_of(task) for task in job.tasks)
    return max(1, min(_cores(), len(job.tasks), _free_bytes() // largest))


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _free_bytes(meminfo: Path = Path("/proc/meminfo"), group: Path = Path("/sys/fs/cgroup")) -> int:
    """Return the memory that is free for new processes, bytes: of the machine, or of the control group (version 2) if it has less."""
    found = [os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")]
    with suppress(OSError):  # another system than Linux
        lines = meminfo.read_text().splitlines()
        found += [int(line.split()[1]) << 10 for line in lines if line.startswith("MemAvailable:")]
    with suppress(OSError, ValueError):  # no control group, or one without a limit ("max")
        found.append(int((group / "memory.max").read_text()) - int((group / "memory.current").read_text()))
    return max(0, min(found))
