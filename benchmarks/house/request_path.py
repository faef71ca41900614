"""Record the files of the service that one real request passes through."""

import inspect
import socket
import threading
from dataclasses import dataclass, field
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import httpx
import uvicorn

from benchmarks.report import ROOT
from service.http.app import create_app
from service.http.protocol import BoundedHttp
from service.runtime.engine import Engine
from service.runtime.settings import Settings

_SERVICE = str(ROOT / "service") + "/"


@dataclass(slots=True)
class Trace:
    """Files of ``service`` whose functions were called, in the order of their first calls.

    Attributes:
        before_engine: files called before the engine.
        in_core: files called between the engine's call and its return.
    """

    before_engine: list[str] = field(default_factory=list)
    in_core: list[str] = field(default_factory=list)
    _is_on: bool = False
    _depth: int = 0
    _asked: bool = False

    def profile(self, frame: FrameType, event: str, _: Any) -> None:
        """Record the file of every call; a callback for ``threading.setprofile``.

        Args:
            frame: frame of the event.
            event: name of the event.
            _: unused argument of the event.
        """
        if not self._is_on or not frame.f_code.co_filename.startswith(_SERVICE):
            return
        is_engine = frame.f_code in _ENGINE
        if event == "call":
            if is_engine:
                self._depth += 1
                self._asked = True
            files = self.in_core if self._depth else self.before_engine
            name = str(Path(frame.f_code.co_filename).relative_to(ROOT))
            if (self._depth or not self._asked) and name not in files:
                files.append(name)
        elif event == "return" and is_engine:
            self._depth -= 1


_ENGINE: frozenset[CodeType] = frozenset(
    inspect.unwrap(each).__code__ for each in (Engine.localize, Engine.localize_sequence)
)


def trace_of_request(bundle: Path, parts: dict[str, tuple[str, bytes, str]]) -> Trace:
    """Send two requests over a socket to a service in this process, one to warm up and one traced.

    Args:
        bundle: map to serve.
        parts: multipart fields of ``POST /v1/localize``: file name, bytes, media type.

    Raises:
        RuntimeError: the service did not answer 200.
    """
    trace = Trace()
    threading.setprofile(trace.profile)  # the threads of the service start below
    try:
        engine = Engine.open(Settings(maps=(bundle,), threads=1))
        try:
            _ask_twice(engine, parts, trace)
        finally:
            engine.close()
    finally:
        threading.setprofile(None)
    return trace


def _ask_twice(engine: Engine, parts: dict[str, tuple[str, bytes, str]], trace: Trace) -> None:
    # The same server and protocol as `streetfix serve`.
    config = uvicorn.Config(create_app(engine), http=BoundedHttp, ws="none", lifespan="off", log_config=None, port=0)
    server = uvicorn.Server(config)
    with socket.create_server(("127.0.0.1", 0)) as listening:
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]})
        thread.start()
        try:
            with httpx.Client(base_url=f"http://127.0.0.1:{listening.getsockname()[1]}", timeout=60.0) as client:
                for trace._is_on in (False, True):
                    answer = client.post("/v1/localize", files=parts)
                    if answer.status_code != 200:
                        raise RuntimeError(f"POST /v1/localize: {answer.status_code} {answer.text}")
        finally:
            trace._is_on = False
            server.should_exit = True
            thread.join()
