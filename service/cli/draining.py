"""A server that reports not ready before it stops, so that load balancers send their requests elsewhere."""

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
    """uvicorn server that drains on SIGTERM.

    On SIGTERM it reports not ready at once and still answers everybody for ``delay_s``. Then it takes no new connections and waits
    for running requests. Ctrl-C or a second SIGTERM skips the delay.

    Args:
        config: of the service.
        engine: marked as draining.
        delay_s: seconds between the signal and the refusal of new connections.
        started: called once the server listens.
        leaving: called after the delay, when the server begins to stop.
        beside: further listeners on the same event loop, each with its configuration, such as the health port. A blocked loop then
            fails the health check too.
    """

    def __init__(
        self,
        config: uvicorn.Config,
        engine: "Engine",
        *,
        delay_s: float,
        started: Callable[[], object] = lambda: None,
        leaving: Callable[[], object] = lambda: None,
        beside: Sequence[tuple[socket.socket, uvicorn.Config]] = (),
    ) -> None:
        super().__init__(config)
        self._engine = engine
        self._delay_s = delay_s
        self._started = started
        self._leaving = leaving
        self._beside = beside
        self._leave_at_s: float | None = None

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Listen on the sockets and on the further listeners.

        Args:
            sockets: of the service.
        """
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
        """Take no new connections and wait for running requests. The gRPC server begins to stop at the same time.

        Args:
            sockets: of the service.
        """
        self._leaving()
        await super().shutdown(sockets)

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Handle a signal: begin to drain, or exit.

        Args:
            sig: number of the signal.
            frame: unused by this class; passed on.
        """
        first = not self._engine.is_draining
        self._engine.drain()
        if first and sig == signal.SIGTERM and self._delay_s > 0:
            self._leave_at_s = time.monotonic() + self._delay_s
            return
        super().handle_exit(sig, frame)

    async def on_tick(self, counter: int) -> bool:
        """Check whether to exit. uvicorn calls this ten times per second.

        The delay ends here and not by a timer. A signal handler must not start the thread of a timer: it may have interrupted the
        start of another thread, and would wait for its lock.

        Args:
            counter: of the ticks.
        """
        if self._leave_at_s is not None and time.monotonic() >= self._leave_at_s:
            self.should_exit = True
        return await super().on_tick(counter)
