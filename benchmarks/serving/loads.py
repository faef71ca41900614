"""Loads of a running service, measured together with its processor time."""

import asyncio
from dataclasses import replace

from benchmarks.serving.machines import Server
from benchmarks.serving.peers.hosts import Host
from model_training.loadtest.drive import Load, Shot, drive
from model_training.loadtest.payloads import Payload
from model_training.loadtest.processes import Usage
from model_training.loadtest.summary import Summary, summarise
from model_training.loadtest.targets import Grpc, Rest, Target

WARM_UP_S = 2.0


def load(server: Server | Host, face: str, sent: list[Payload], how: Load) -> tuple[Summary, list[Shot]]:
    """Run one load; return its summary and its requests.

    Args:
        server: service under test.
        face: ``rest`` or ``grpc``; a peer has ``rest`` only.
        sent: requests, sent in turn.
        how: amount of load.

    Raises:
        ValueError: gRPC is asked of a peer.
    """
    if face != "rest" and isinstance(server, Host):
        raise ValueError(f"face: {face!r} is not available for a peer; use 'rest'")
    before: Usage | None = None
    after: Usage | None = None

    def tick(seconds: float) -> None:
        nonlocal before, after
        if seconds >= how.warm_up_s:
            after = server.used
            before = after if before is None else before

    async def run() -> list[Shot]:
        target: Target = Rest(server.url, key=None)
        if face != "rest" and isinstance(server, Server):
            target = Grpc(server.grpc, key=None)
        async with target:
            return await drive(target, sent, how, tick)

    shots = asyncio.run(run())
    return summarise(shots, sent, how, before, after), shots


def closed(seconds: float, clients: int) -> Load:
    """Return a load of clients that wait for each answer.

    Args:
        seconds: measured duration.
        clients: number of clients.
    """
    return Load(rate=None, concurrency=clients, warm_up_s=WARM_UP_S, duration_s=seconds)


def opened(seconds: float, rate: float) -> Load:
    """Return a load of random arrivals that wait for nothing.

    Args:
        seconds: measured duration.
        rate: arrivals per second.
    """
    return replace(closed(seconds, 1), rate=rate)
