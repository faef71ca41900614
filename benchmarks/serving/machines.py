"""What is measured and what measures, each in a process of its own, each on a core of its own."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self

import httpx

from benchmarks.report import ROOT
from model_training.loadtest.processes import Usage, usage

SERVED_CORE, LOADING_CORE = 0, 1
_CORES = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else set()
_SERVE = [sys.executable, "-c", "from service.cli.main import main; main()", "serve"]


def pin(pid: int, core: int | None) -> None:
    """Keep a process, and what it starts, on one core; None lets it have all."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(pid, _CORES if core is None else {core})


class Server:
    """The real command, on ports of its own.

    Args:
        maps: bundle, or folder of bundles.
        core: it is pinned to; None for all.
        enter: called in its process before it begins, as to enter a control group.
        settings: as in the environment, lower case.
    """

    def __init__(
        self, maps: Path, *, core: int | None = SERVED_CORE, enter: Callable[[], None] | None = None, **settings: object
    ) -> None:
        environment = os.environ | {f"STREETFIX_{name.upper()}": str(value) for name, value in settings.items()}
        began = time.perf_counter()
        self.process = subprocess.Popen(
            [*_SERVE, str(maps), "--port", "0", "--grpc-port", "0"], cwd=ROOT, env=environment, stdout=subprocess.PIPE, text=True,
            preexec_fn=enter,  # the load generator has not begun its threads yet
        )  # fmt: skip
        pin(self.process.pid, core)
        told = _until(self.process.stdout, r"serving gRPC at (\S+)", r"serving at (\S+)")
        self.grpc, self.url = told
        while httpx.get(f"{self.url}/readyz", timeout=30).status_code != 200:
            time.sleep(0.005)
        self.ready_s = time.perf_counter() - began

    def __enter__(self) -> Self:
        """It runs already."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop it."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
        self.process.communicate(timeout=120)

    @property
    def used(self) -> Usage:
        """Processor time and memory of it and its children."""
        return usage(self.process.pid)


def _until(stream: IO[str] | None, *patterns: str) -> list[str]:
    """First groups of patterns, each found in a line after the one before."""
    found: list[str] = []
    for line in stream or ():
        if match := re.search(patterns[len(found)], line):
            found.append(match[1])
            if len(found) == len(patterns):
                return found
    raise RuntimeError(f"the service ended before it said {patterns[len(found)]!r}")


class Bare:
    """``benchmarks.serving.bare`` in a process of its own."""

    def __init__(
        self, bundle: Path, dataset: Path, queries: str, pairs: int, *, core: int | None = SERVED_CORE
    ) -> None:
        command = [sys.executable, "-m", "benchmarks.serving.bare", str(bundle), str(dataset), queries, str(pairs)]
        self.process = subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        pin(self.process.pid, core)
        self._line()

    def __enter__(self) -> Self:
        """It runs already."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop it."""
        self.process.communicate(timeout=120)

    def run(self, what: str, seconds: float) -> dict[str, float]:
        """``full``, ``retrieval`` or ``retrieval fast`` for some seconds: ``cpu_ms`` of each, ``per_s``, ``n``."""
        name, *more = what.split()
        if self.process.stdin is None:
            raise RuntimeError("the bare pipeline takes no input")
        print(name, seconds, *more, file=self.process.stdin, flush=True)
        return self._line()

    def _line(self) -> dict[str, Any]:
        line = "" if self.process.stdout is None else self.process.stdout.readline()
        if not line:
            raise RuntimeError("the bare pipeline ended")
        told: dict[str, Any] = json.loads(line)
        return told


def proportional_mib(pid: int) -> float:
    """Memory of a process in MiB, pages that several share counted in parts (Pss)."""
    text = (Path("/proc") / str(pid) / "smaps_rollup").read_text()
    found = re.search(r"^Pss:\s+(\d+) kB", text, re.MULTILINE)
    if found is None:
        raise RuntimeError(f"/proc/{pid}/smaps_rollup says no Pss")
    return int(found[1]) / 1024
