"""The processes under test and their clients, each process on its own core."""

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
#: Time after which a service that is not ready is ended, seconds.
_READY_S = 300.0
#: Time after which a service that does not stop is killed, seconds.
_STOP_S = 120.0
_CORES = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else set()
_SERVE = [sys.executable, "-c", "from service.cli.main import main; main()", "serve"]


def pin(pid: int, core: int | None) -> None:
    """Keep a process, and the processes that it starts, on one core.

    Args:
        pid: the process; 0 for this one.
        core: number of the core; None allows all.
    """
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
    """Start the real command; its first lines on standard output give its addresses.

    Args:
        maps: bundle, or folder of bundles.
        port: port of REST; 0 lets the system choose.
        grpc_port: port of gRPC; 0 lets the system choose.
        stderr: target of its log; None shows it.
        temporary: folder of its temporary files; None leaves that to the system.
        enter: called in its process before it begins, for example to enter a control group.
        **settings: settings as in the environment, in lower case.
    """
    environment = os.environ | {f"STREETFIX_{name.upper()}": str(value) for name, value in settings.items()}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)  # as installed: otherwise each start would compile 200 modules
    if temporary is not None:
        environment["TMPDIR"] = str(temporary)
    return subprocess.Popen(
        [*_SERVE, str(maps), "--port", str(port), "--grpc-port", str(grpc_port)],
        cwd=ROOT,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=stderr,
        text=True,
        process_group=0,  # Ctrl-C ends the measurement, which then ends the service
        preexec_fn=enter,  # the load generator has not started its threads yet
    )


class Server:
    """The real command, started and ready.

    Args:
        maps: bundle, or folder of bundles.
        core: core that it is pinned to; None for all.
        trusted: TLS context that trusts its certificate; None without TLS.
        log: receives each line of its log; None shows them.
        **launching: further arguments of ``launch``.

    Raises:
        RuntimeError: it ended before it was ready.
    """

    def __init__(
        self,
        maps: Path,
        *,
        core: int | None = SERVED_CORE,
        trusted: ssl.SSLContext | None = None,
        log: Callable[[str], None] | None = None,
        **launching: Any,
    ) -> None:
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
        except BaseException:  # for example Ctrl-C: nobody else would end it
            kill_tree(self.process.pid)
            self.wait()
            raise
        finally:
            late.cancel()
        self.ready_s = time.perf_counter() - began

    def __enter__(self) -> Self:
        """Return itself: the service runs already."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop the service. If it does not stop, it is killed.

        Raises:
            subprocess.TimeoutExpired: it did not stop by itself.
        """
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
        try:
            self.wait(_STOP_S)
        except BaseException:
            kill_tree(self.process.pid)
            self.wait()
            raise

    def wait(self, timeout_s: float | None = None) -> int:
        """Wait for the end of the service and of its log; return its exit code.

        Args:
            timeout_s: longest time to wait, seconds; None waits without limit.

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
        """Processor time and memory of the service and its children."""
        return usage(self.process.pid)


def kill_tree(pid: int) -> None:
    """Kill a process and all its descendants at once.

    Args:
        pid: the process.
    """
    try:
        tree = descendants(pid)
    except StreetfixError:  # already ended
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
    """Return the first groups of patterns, each found in a line after the previous one."""
    found: list[str] = []
    for line in stream or ():
        if match := re.search(patterns[len(found)], line):
            found.append(match[1])
            if len(found) == len(patterns):
                return found
    raise RuntimeError(f"the service ended before it printed {patterns[len(found)]!r}")


class Bare:
    """``benchmarks.serving.bare`` in its own process.

    Args:
        bundle: the map.
        dataset: folder of the dataset.
        queries: name of the query set.
        pairs: number of queries to use.
        core: core that it is pinned to; None for all.
    """

    def __init__(
        self, bundle: Path, dataset: Path, queries: str, pairs: int, *, core: int | None = SERVED_CORE
    ) -> None:
        command = [sys.executable, "-m", "benchmarks.serving.bare", str(bundle), str(dataset), queries, str(pairs)]
        self.process = subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        pin(self.process.pid, core)
        self._line()

    def __enter__(self) -> Self:
        """Return itself: the process runs already."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop the process."""
        self.process.communicate(timeout=120)

    def run(self, what: str, seconds: float) -> dict[str, float]:
        """Run the pipeline for some seconds; return ``cpu_ms`` of each query, ``per_s`` and ``n``.

        Args:
            what: ``full``, ``retrieval`` or ``retrieval fast``.
            seconds: duration.

        Raises:
            RuntimeError: the process takes no input.
        """
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
    """Return the memory of a process in MiB; shared pages count in parts (Pss).

    Args:
        pid: the process.

    Raises:
        RuntimeError: the system does not report Pss.
    """
    text = (Path("/proc") / str(pid) / "smaps_rollup").read_text()
    found = re.search(r"^Pss:\s+(\d+) kB", text, re.MULTILINE)
    if found is None:
        raise RuntimeError(f"/proc/{pid}/smaps_rollup has no Pss")
    return int(found[1]) / 1024


def peak_mib(pid: int) -> float:
    """Return the largest resident memory of a process since its start, MiB (``VmHWM``), summed over it and its descendants.

    Args:
        pid: the process.

    Raises:
        RequestError: there is no such process.
        RuntimeError: the system does not report VmHWM.
    """
    total = 0.0
    for each in descendants(pid):
        found = re.search(r"^VmHWM:\s+(\d+) kB$", Path(f"/proc/{each}/status").read_text(), re.MULTILINE)
        if found is None:
            raise RuntimeError(f"/proc/{each}/status has no VmHWM")
        total += int(found[1]) / 1024
    return total


@dataclass(frozen=True, slots=True)
class Held:
    """Resources of a process and its descendants at a moment.

    Attributes:
        anonymous_mib: pages without a file (``Pss_Anon``), shared ones in parts. Pages of mapped maps come and go,
            these stay.
        private_dirty_mib: pages that only one process has written (``Private_Dirty``).
        resident_mib: all pages in memory (``Rss``).
        descriptors: open files and sockets.
        threads: threads of all processes.
    """

    anonymous_mib: float
    private_dirty_mib: float
    resident_mib: float
    descriptors: int
    threads: int


def held(pid: int) -> Held:
    """Return the resources of a process and its descendants now; a process that ends meanwhile is left out.

    Args:
        pid: the process.
    """
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
