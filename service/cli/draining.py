"""A server that says it is leaving before it leaves, so that balancers send their requests elsewhere."""

import asyncio
import signal
import socket
import time
from collections.abc import Callable, Sequence
from types import FrameType
from typing import TYPE_CHECKING

import uvicorn

if TYPE_CHECKING:
    from service.runtime.engine import Engine


class DrainingServer(uvicorn.Server):
    """On SIGTERM: not ready at once, then a while of answering everybody, then no new connections, then the end of running requests.

    Ctrl-C, and a second SIGTERM, skip the while.

    Args:
        config: of the service.
        engine: that is told first.
        delay_s: the while, seconds.
        started: called once it listens.
        leaving: called when it is over.
        beside: further listeners of the same loop, each with its configuration, as the health port's: a loop that hangs must not
            look alive.
    """

    def __init__(
        self, config: uvicorn.Config, engine: "Engine", *, delay_s: float, started: Callable[[], object] = lambda: None,
        leaving: Callable[[], object] = lambda: None,
        beside: Sequence[tuple[socket.socket, uvicorn.Config]] = (),
    ) -> None:  # fmt: skip
        super().__init__(config)
        self._engine = engine
        self._delay_s = delay_s
        self._started = started
        self._leaving = leaving
        self._beside = beside
        self._leave_at_s: float | None = None

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Listen, beside too."""
        await super().startup(sockets)
        for listener, config in self._beside:
            config.load()

            def protocol(config: uvicorn.Config = config) -> asyncio.Protocol:
                made: asyncio.Protocol = config.http_protocol_class(config, self.server_state, {})  # type: ignore[call-arg]
                return made

            server = await asyncio.get_running_loop().create_server(protocol, sock=listener, backlog=config.backlog)
            self.servers.append(server)
        self._started()

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """No new connections, then the end of running requests; other faces begin to leave at the same moment."""
        self._leaving()
        await super().shutdown(sockets)

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Uvicorn's handler of signals."""
        first = not self._engine.is_draining
        self._engine.drain()
        if first and sig == signal.SIGTERM and self._delay_s > 0:
            self._leave_at_s = time.monotonic() + self._delay_s
            return
        super().handle_exit(sig, frame)

    async def on_tick(self, counter: int) -> bool:
        """Uvicorn's look at what is to be done, ten times a second; whether to leave.

        The while is watched here: a timer's thread cannot be started in a signal handler, which may have interrupted the start of
        another thread, whose lock it would wait for.
        """
        if self._leave_at_s is not None and time.monotonic() >= self._leave_at_s:
            self.should_exit = True
        return await super().on_tick(counter)
