"""Sends requests at a rate that does not wait for answers, or from so many clients that each do."""

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
        due_s: when it was to be sent, from the run's beginning; latency counts from here, so that a generator or a service that falls
            behind does not hide it (Tene's coordinated omission).
        sent_s: when the generator came to send it; what lies between is the generator's own lateness.
        done_s: when its outcome was known.
        payload: number of the request sent.
        reply: what came back.
    """

    due_s: float
    sent_s: float
    done_s: float
    payload: int
    reply: Reply


@dataclass(frozen=True, slots=True, kw_only=True)
class Load:
    """How much.

    Attributes:
        rate: requests a second, arriving at random (a Poisson process); None for ``concurrency``.
        concurrency: clients that each send the next request when they have an answer.
        warm_up_s: the first seconds, which do not count.
        duration_s: the seconds that do.
        timeout_s: after which a request is given up.
        seed: of the arrivals.
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
    """Load a target; the shots of warm-up and run, by due time.

    Args:
        target: opened.
        payloads: sent in turn.
        load: how much.
        tick: told the seconds since the beginning, now and then.
    """
    gc.collect()
    gc.freeze()  # else a full collection, of all that was ever imported, holds up what is due for 70 ms
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
    """Times of a Poisson process of so many a second, until the total."""
    rng = np.random.default_rng(seed)
    gaps = rng.exponential(1 / rate, size=int(rate * total_s + 10 * np.sqrt(rate * total_s) + 20))
    times = np.cumsum(gaps)
    return [float(t) for t in times[times < total_s]]
