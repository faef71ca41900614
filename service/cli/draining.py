"""A server that says it is leaving before it leaves, so that balancers send their requests elsewhere."""

import signal
import socket
import threading
from collections.abc import Callable
from types import FrameType
from typing import TYPE_CHECKING

import uvicorn

if TYPE_CHECKING:
    from service.runtime.engine import Engine


class DrainingServer(uvicorn.Server):
    """On SIGTERM: not ready at once, then a while of answering everybody, then no new connections, then the end of running requests.

    Ctrl-C, and a second SIGTERM, skip the while.
    """

    def __init__(
        self, config: uvicorn.Config, engine: "Engine", *, delay_s: float, leaving: Callable[[], object] = lambda: None
    ) -> None:
        super().__init__(config)
        self._engine = engine
        self._delay_s = delay_s
        self._leaving = leaving

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """No new connections, then the end of running requests; other faces begin to leave at the same moment."""
        self._leaving()
        await super().shutdown(sockets)

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Uvicorn's handler of signals."""
        first = not self._engine.is_draining
        self._engine.drain()
        if first and sig == signal.SIGTERM and self._delay_s > 0:
            timer = threading.Timer(self._delay_s, super().handle_exit, (sig, frame))
            timer.daemon = True
            timer.start()
            return
        super().handle_exit(sig, frame)
