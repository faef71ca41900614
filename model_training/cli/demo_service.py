"""Run ``streetfix serve`` as a child process inside a context."""

import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import IO, NoReturn

import httpx

from service.errors import UnreachableError

_COMMAND = (sys.executable, "-P", "-c", "from service.cli.main import main; main()", "serve")
_READY_S, _POLL_S, _END_S = 60.0, 0.05, 15.0


@dataclass(frozen=True, slots=True)
class RunningService:
    """A service that is ready.

    Attributes:
        url: its address.
        process: its process.
    """

    url: str
    process: "subprocess.Popen[str]"

    def wait(self) -> NoReturn:
        """Wait until the user presses Ctrl-C (KeyboardInterrupt).

        Raises:
            UnreachableError: the service ended unexpectedly.
        """
        status = self.process.wait()
        raise UnreachableError(f"{self.url}: the service ended unexpectedly (status {status}); see its messages above")


@contextmanager
def serving(bundle: Path, port: int, samples: Path | None = None) -> Iterator[RunningService]:
    """Serve a map on loopback inside the context. The service ends with it, also after Ctrl-C, a kill or a closed terminal.

    Args:
        bundle: the map.
        port: 0 lets the system choose.
        samples: pairs for the console, if there are any.

    Raises:
        UnreachableError: the service did not start; it has said why on stderr.
    """
    given = [] if samples is None else ["--samples", str(samples)]
    # A group of its own: Ctrl-C in a terminal reaches this process alone, which then ends the service in good order.
    process = subprocess.Popen(  # noqa: S603  # this interpreter, our own command
        [*_COMMAND, str(bundle), "--host", "127.0.0.1", "--port", str(port), *given],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        text=True,
        process_group=0,
    )
    try:
        with _endings_as_ctrl_c():
            url = _address(process)
            _wait_until_ready(process, url)
            yield RunningService(url, process)
    finally:
        _end(process)


@contextmanager
def _endings_as_ctrl_c() -> Iterator[None]:
    def interrupt(_number: int, _frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    before = {number: signal.signal(number, interrupt) for number in (signal.SIGTERM, signal.SIGHUP)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _address(process: "subprocess.Popen[str]") -> str:
    for line in _lines(process.stdout):
        if found := re.search(r"serving at (http://\S+)", line):
            return found[1]
    raise UnreachableError(f"the service did not start (status {process.wait()}); see its messages above")


def _lines(stream: IO[str] | None) -> Iterator[str]:
    yield from stream or ()


def _wait_until_ready(process: "subprocess.Popen[str]", url: str) -> None:
    until = time.monotonic() + _READY_S
    with httpx.Client(trust_env=False, timeout=_READY_S) as client:  # no proxy on the way to loopback
        while process.poll() is None and time.monotonic() < until:
            try:
                if client.get(f"{url}/readyz").is_success:
                    return
            except httpx.TransportError:
                pass  # it listens before it answers
            time.sleep(_POLL_S)
    raise UnreachableError(
        f"{url}/readyz: the service ended, or is not ready after {_READY_S:.0f} s; see its messages above"
    )


def _end(process: "subprocess.Popen[str]") -> None:
    process.terminate()
    try:
        process.wait(_END_S)
    except (subprocess.TimeoutExpired, KeyboardInterrupt):  # a second Ctrl-C ends at once
        process.kill()
        process.wait()
    if process.stdout is not None:
        process.stdout.close()
