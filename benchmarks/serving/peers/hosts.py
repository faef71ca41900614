"""A peer's server as a tree of processes on one core: start, request, measurement and stop."""

import json
import os
import shutil
import signal
import subprocess
import tempfile
import time
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import httpx

from benchmarks.report import ROOT
from benchmarks.serving.machines import SERVED_CORE, pin
from benchmarks.serving.peers.ports import free_port
from benchmarks.serving.peers.venvs import PeerError
from model_training.loadtest.payloads import Payload
from model_training.loadtest.processes import Usage, descendants, usage

START_S, STOP_S = 300.0, 30.0


class Host:
    """A running peer.

    Args:
        command: command that listens on a port; the port is appended.
        first: request that is sent until the peer answers.
        core: core that it is pinned to; None for all.
        patience_s: longest time of the start, seconds.

    Raises:
        PeerError: it ended, or did not answer in time.
    """

    def __init__(
        self, command: list[str], first: Payload, *, core: int | None = SERVED_CORE, patience_s: float = START_S
    ) -> None:
        port = free_port()
        self.url = f"http://127.0.0.1:{port}"
        self._folder = Path(tempfile.mkdtemp(prefix="peer-"))  # some peers write files where they are started
        # The peers use the code of this checkout. They do not import the parts whose dependencies their environments
        # lack.
        environment = os.environ | {
            "PYTHONPATH": str(ROOT),
            "BENTOML_HOME": str(self._folder),
            "BENTOML_DO_NOT_TRACK": "True",
        }
        with (self._folder / "log").open("wb") as log:
            self.process = subprocess.Popen(
                [*command, str(port)],
                cwd=self._folder,
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
            )
        pin(self.process.pid, core)
        try:
            self._wait(first, patience_s)
        except BaseException:
            self.stop()
            raise

    def __enter__(self) -> Self:
        """Return itself: the peer runs already."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop the peer."""
        self.stop()

    @property
    def used(self) -> Usage:
        """Processor time and memory of the peer and its children."""
        return usage(self.process.pid)

    def stop(self) -> None:
        """End the tree: send SIGTERM, then kill the remaining processes.

        Raises:
            PeerError: some processes did not end.
        """
        tree = {pid: _began(pid) for pid in descendants(self.process.pid)} if self.process.poll() is None else {}
        if tree:
            self.process.send_signal(signal.SIGTERM)
            try:
                self.process.wait(STOP_S)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait()
        for pid, began in tree.items():
            if began is not None and _began(pid) == began:  # not another process that reuses the number
                os.kill(pid, signal.SIGKILL)
        deadline = time.monotonic() + STOP_S
        while any(began is not None and _began(pid) == began for pid, began in tree.items()):
            if time.monotonic() > deadline:
                raise PeerError(f"its processes did not end: {sorted(tree)}")
            time.sleep(0.01)
        shutil.rmtree(self._folder, ignore_errors=True)

    def _wait(self, first: Payload, patience_s: float) -> None:
        deadline = time.monotonic() + patience_s
        last = "nothing listens"
        while time.monotonic() < deadline:
            if self.process.poll() is not None:
                raise PeerError(f"the server ended with code {self.process.returncode}: {self._said()}")
            try:
                answered = httpx.post(
                    f"{self.url}/v1/localize",
                    content=first.body,
                    headers={"Content-Type": first.content_type},
                    timeout=30,
                )
            except httpx.TransportError as error:
                last = type(error).__name__
            else:
                if answered.status_code == 200:
                    return
                last = f"{answered.status_code} {answered.text[:200]}"
            time.sleep(0.2)
        raise PeerError(f"no answer within {patience_s:.0f} s, the last was {last}: {self._said()}")

    def _said(self) -> str:
        """Return the end of the log on one line."""
        return " ".join((self._folder / "log").read_text(errors="replace").split())[-300:]


def ask(url: str, payload: Payload) -> dict[str, Any]:
    """Return the answer to one request.

    Args:
        url: address of the peer.
        payload: the request.

    Raises:
        PeerError: there is no answer, or its status is not 200.
    """
    try:
        answered = httpx.post(
            f"{url}/v1/localize", content=payload.body, headers={"Content-Type": payload.content_type}, timeout=60
        )
    except httpx.TransportError as error:
        raise PeerError(f"no answer: {type(error).__name__}") from error
    if answered.status_code != 200:
        raise PeerError(f"it answered {answered.status_code}: {answered.text[:200]}")
    told: dict[str, Any] = json.loads(answered.content)
    return told


def _began(pid: int) -> str | None:
    """Return the start time of a process in kernel ticks; None if it does not exist or is a zombie."""
    try:
        fields = (Path("/proc") / str(pid) / "stat").read_text().rpartition(")")[2].split()
    except OSError:
        return None
    return None if fields[0] == "Z" else fields[19]
