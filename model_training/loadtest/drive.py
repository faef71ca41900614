"""Send requests at a rate that does not wait for answers, or from clients that each wait."""

import asyncio
import gc
import itertools
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from model_training.loadtest.payloads import Payload
from model_training.loadtest.targets import Reply, Target


@dataclass(frozen=True, slots=True)
class Shot:
    """One request of a run.

    Attributes:
        due_s: scheduled time, seconds since the start. Latency counts from here, so that a late generator or service
            does not hide it (Tene's coordinated omission).
        sent_s: time of sending, seconds since the start; the difference is the generator's own delay.
        done_s: time of the outcome, seconds since the start.
        payload: number of the request.
        reply: the outcome.
    """

    due_s: float
    sent_s: float
    done_s: float
    payload: int
    reply: Reply


@dataclass(frozen=True, slots=True, kw_only=True)
class Load:
    """Amount of load.

    Attributes:
        rate: requests per second that arrive at random (a Poisson process); None uses ``concurrency``.
        concurrency: number of clients that each send the next request after an answer.
        warm_up_s: duration of the warm-up, seconds; it does not count.
        duration_s: duration that counts, seconds.
        timeout_s: time after which a request is given up, seconds.
        seed: seed of the arrivals.
    """

    rate: float | None
    concurrency: int = 1
    warm_up_s: float = 3.0
    duration_s: float = 20.0
    timeout_s: float = 30.0
    seed: int = 0


async def drive(
    target: Target, payloads: list[Payload], load: Load, tick: Callable[[float], None] = lambda _: None
) -> list[Shot]:
    """Load a target; return the requests of warm-up and run, sorted by scheduled time.

    Args:
        target: an open target.
        payloads: requests, sent in turn.
        load: amount of load.
        tick: receives the seconds since the start, several times per second.
    """
    gc.collect()
    gc.freeze()  # otherwise a full garbage collection of all imported objects delays requests by 70 ms
    turn, shots, began = itertools.count(), list[Shot](), time.perf_counter()
    total = load.warm_up_s + load.duration_s

    def now() -> float:
        return time.perf_counter() - began

    async def send(due_s: float) -> None:
        number, sent_s = next(turn) % len(payloads), now()
        try:
            async with asyncio.timeout(load.timeout_s):
                reply = await target.ask(payloads[number], load.timeout_s)
        except TimeoutError:
            reply = Reply("timeout")
        shots.append(Shot(due_s, sent_s, now(), number, reply))

    async def client() -> None:
        while now() < total:
            await send(now())

    async def clock() -> None:
        while now() < total:
            tick(now())
            await asyncio.sleep(min(0.25, max(0.0, total - now())))
        tick(total)

    try:
        async with asyncio.TaskGroup() as group:
            group.create_task(clock())
            if load.rate is None:
                for _ in range(load.concurrency):
                    group.create_task(client())
            else:
                for due_s in arrivals(load.rate, total, load.seed):
                    await asyncio.sleep(max(0.0, due_s - now()))
                    group.create_task(send(due_s))
    finally:
        gc.unfreeze()
    return sorted(shots, key=lambda shot: shot.due_s)


def arrivals(rate: float, total_s: float, seed: int) -> list[float]:
    """Draw the times of a Poisson process, seconds.

    Args:
        rate: arrivals per second.
        total_s: end of the process, seconds.
        seed: seed of the arrivals.
    """
    rng = np.random.default_rng(seed)
    gaps = rng.exponential(1 / rate, size=int(rate * total_s + 10 * np.sqrt(rate * total_s) + 20))
    times = np.cumsum(gaps)
    return [float(t) for t in times[times < total_s]]
