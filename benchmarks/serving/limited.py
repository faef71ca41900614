"""A memory limit for a process and its children: a control group where possible, else a watcher that kills."""

import os
import signal
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Self

from model_training.loadtest.processes import usage
from service.errors import RequestError

_ROOT = Path("/sys/fs/cgroup")
_EVERY_S = 0.02


class Limited:
    """Memory limit for each process that calls ``enter`` (in a child, before it executes).

    Args:
        limit_mib: limit of the memory, MiB; no swap is added.
    """

    def __init__(self, limit_mib: int) -> None:
        self.limit_mib = limit_mib
        self.how = ""
        self._folder: Path | None = None
        self._version = 0
        self._peak_mib, self._watched_kills = 0.0, 0
        self._over = threading.Event()
        self._watcher: threading.Thread | None = None
        for version, root, name in (
            (2, _ROOT, "memory.max"),
            (1, _ROOT / "memory", "memory.limit_in_bytes"),
        ):
            folder = root / f"streetfix-bench-{os.getpid()}"
            if not (root / "cgroup.procs").exists():  # otherwise the root is a plain folder, and ours would be one too
                continue
            try:
                folder.mkdir()
                if not (folder / name).exists():
                    raise OSError("no memory controller")
                (folder / name).write_text(str(limit_mib * 2**20))
            except OSError:  # this version, the controller or the permission is missing
                with suppress(OSError):
                    folder.rmdir()
                continue
            self._folder, self._version = folder, version
            self.how = f"control group version {version}"
            return
        self.how = (
            "a watcher that kills the process above the limit of anonymous memory; no control group could be created "
            "on this machine"
        )

    @property
    def enter(self) -> Callable[[], None] | None:
        """Function for ``preexec_fn``; None if the child needs none."""
        if self._folder is None:
            return None
        procs = self._folder / "cgroup.procs"
        return lambda: _join(procs)

    def watch(self, pid: int) -> None:
        """Watch the memory of a process from now on.

        Args:
            pid: the process.
        """
        self._watcher = threading.Thread(target=self._look, args=(pid,), daemon=True)
        self._watcher.start()

    @property
    def killed(self) -> int:
        """Number of processes that were killed for their memory."""
        if self._folder is None:
            return self._watched_kills
        name = "memory.events" if self._version == 2 else "memory.oom_control"
        words = [line.split() for line in (self._folder / name).read_text().splitlines()]
        return sum(int(value) for key, value in words if key == "oom_kill")

    @property
    def peak_mib(self) -> float:
        """Largest memory without file pages, MiB, sampled every 20 ms."""
        return self._peak_mib

    def __enter__(self) -> Self:
        """Return itself: the limit exists already."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Remove the group; its processes must have ended."""
        self._over.set()
        if self._watcher is not None:
            self._watcher.join()
        if self._folder is not None:
            self._folder.rmdir()

    def _look(self, pid: int) -> None:
        while not self._over.wait(_EVERY_S):
            try:
                now = self._anonymous_mib(pid)
            except (OSError, RequestError):  # already ended
                return
            self._peak_mib = max(self._peak_mib, now)
            if self._folder is None and now > self.limit_mib:
                self._watched_kills += 1
                os.kill(pid, signal.SIGKILL)
                return

    def _anonymous_mib(self, pid: int) -> float:
        if self._folder is None:
            return usage(pid).anonymous_mib
        wanted = {"anon", "shmem", "sock", "kernel"} if self._version == 2 else {"rss", "shmem"}
        lines = (self._folder / "memory.stat").read_text().splitlines()
        return sum(int(line.split()[1]) for line in lines if line.split()[0] in wanted) / 2**20


def _join(procs: Path) -> None:
    procs.write_text(str(os.getpid()))
