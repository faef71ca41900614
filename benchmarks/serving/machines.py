"""What is measured and what measures, each in a process of its own, each on a core of its own."""

import json
import os
import re
import signal
import ssl
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self

import httpx

from benchmarks.report import ROOT
from model_training.loadtest.processes import Usage, descendants, usage
from service.errors import StreetfixError

SERVED_CORE, LOADING_CORE = 0, 1
#: A service that is not ready after this long is ended.
_READY_S = 300.0
_CORES = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else set()
_SERVE = [sys.executable, "-c", "from service.cli.main import main; main()", "serve"]


def pin(pid: int, core: int | None) -> None:
    """Keep a process, and what it starts, on one core; None lets it have all."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(pid, _CORES if core is None else {core})


def launch(
    maps: Path,
    *,
    port: int = 0,
    grpc_port: int = 0,
    stderr: IO[str] | int | None = None,
    temporary: Path | None = None,
    enter: Callable[[], None] | None = None,
    **settings: object,
) -> subprocess.Popen[str]:
    """Start the real command; its first lines on standard output say where it listens.

    Args:
        maps: bundle, or folder of bundles.
        port: of REST; 0 lets the system choose.
        grpc_port: of gRPC; 0 lets the system choose.
        stderr: where its log goes; None shows it.
        temporary: folder of its temporary files; None leaves that to the system.
        enter: called in its process before it begins, as to enter a control group.
        settings: as in the environment, lower case.
    """
    environment = os.environ | {f"STREETFIX_{name.upper()}": str(value) for name, value in settings.items()}
    if temporary is not None:
        environment["TMPDIR"] = str(temporary)
    return subprocess.Popen(
        [*_SERVE, str(maps), "--port", str(port), "--grpc-port", str(grpc_port)], cwd=ROOT, env=environment,
        stdout=subprocess.PIPE, stderr=stderr, text=True,
        process_group=0,  # Ctrl-C ends the measurement, which then ends the service
        preexec_fn=enter,  # the load generator has not begun its threads yet
    )  # fmt: skip


class Server:
    """The real command, until it is ready.

    Args:
        maps: bundle, or folder of bundles.
        core: it is pinned to; None for all.
        trusted: authorities of its certificate, where it speaks TLS.
        log: gets each line of its log; None shows them.
        launching: as of ``launch``.

    Raises:
        RuntimeError: it ended before it was ready.
    """

    def __init__(
        self, maps: Path, *, core: int | None = SERVED_CORE, trusted: ssl.SSLContext | None = None,
        log: Callable[[str], None] | None = None, **launching: Any,
    ) -> None:  # fmt: skip
        began = time.perf_counter()
        self.process = launch(maps, stderr=None if log is None else subprocess.PIPE, **launching)
        pin(self.process.pid, core)
        self._hearing: threading.Thread | None = None
        if log is not None and self.process.stderr is not None:
            self._hearing = threading.Thread(target=_pass_on, args=(self.process.stderr, log), daemon=True)
            self._hearing.start()
        late = threading.Timer(_READY_S, kill_tree, (self.process.pid,))
        late.start()
        try:
            self.grpc, self.url = _until(self.process.stdout, r"serving gRPC at (\S+)", r"serving at (\S+)")
            while httpx.get(f"{self.url}/readyz", timeout=30, verify=trusted or True).status_code != 200:
                time.sleep(0.005)
        except (httpx.TransportError, RuntimeError) as error:
            kill_tree(self.process.pid)
            self.wait()
            raise RuntimeError(f"the service ended before it was ready: {error!r}") from error
        finally:
            late.cancel()
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
        self.wait(120)

    def wait(self, timeout_s: float | None = None) -> int:
        """Wait for its end and for the end of its log; its exit code.

        Raises:
            subprocess.TimeoutExpired: it has not ended.
        """
        if self._hearing is None:
            self.process.communicate(timeout=timeout_s)
            return self.process.returncode
        code = self.process.wait(timeout_s)
        self._hearing.join(timeout_s)
        for stream in (self.process.stdout, self.process.stderr):
            if stream is not None:
                stream.close()
        return code

    @property
    def used(self) -> Usage:
        """Processor time and memory of it and its children."""
        return usage(self.process.pid)


def kill_tree(pid: int) -> None:
    """End a process and all that came of it, at once."""
    try:
        tree = descendants(pid)
    except StreetfixError:  # it has ended
        return
    for each in tree:
        try:
            os.kill(each, signal.SIGKILL)
        except ProcessLookupError:
            continue


def _pass_on(stream: IO[str], log: Callable[[str], None]) -> None:
    for line in stream:
        log(line)


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


@dataclass(frozen=True, slots=True)
class Held:
    """What a process and its descendants hold at a moment.

    Attributes:
        anonymous_mib: pages of no file (``Pss_Anon``), shared ones counted in parts; pages of mapped maps come and go, these stay.
        private_dirty_mib: pages that a process alone has written (``Private_Dirty``).
        resident_mib: all pages in memory (``Rss``).
        descriptors: open files and sockets.
        threads: of all processes.
    """

    anonymous_mib: float
    private_dirty_mib: float
    resident_mib: float
    descriptors: int
    threads: int


def held(pid: int) -> Held:
    """What a process and its descendants hold now; one that ends meanwhile is left out."""
    memory, descriptors, threads = {"Pss_Anon": 0.0, "Private_Dirty": 0.0, "Rss": 0.0}, 0, 0
    for each in descendants(pid):
        folder = Path("/proc") / str(each)
        try:
            fields = dict(re.findall(r"^(\w+):\s+(\d+) kB$", (folder / "smaps_rollup").read_text(), re.MULTILINE))
            files = len(os.listdir(folder / "fd"))
            told = re.search(r"^Threads:\s+(\d+)$", (folder / "status").read_text(), re.MULTILINE)
        except OSError:
            continue
        for name in memory:
            memory[name] += int(fields[name]) / 1024
        descriptors += files
        threads += 0 if told is None else int(told[1])
    return Held(memory["Pss_Anon"], memory["Private_Dirty"], memory["Rss"], descriptors, threads)
