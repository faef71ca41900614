"""The stages of a request, and how long each took.

``timed_request`` marks a request and ``stage`` a part of it. The durations belong to the context of the running code, so concurrent
requests never share them, and no function passes a timer on. A block costs about 1 us.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from time import perf_counter
from typing import Literal, get_args

Stage = Literal["decode", "fuse", "encode", "search", "register"]
#: All stages, in their order. ``service.localization.answer.Timings`` says what each contains.
STAGES: tuple[Stage, ...] = get_args(Stage)

#: Seconds of each stage of the running request; None outside of a request.
_seconds: ContextVar[dict[Stage, float] | None] = ContextVar("stage_seconds", default=None)


@contextmanager
def timed_request() -> Iterator[None]:
    """Measure the stages of one request. It is also a decorator: ``@timed_request()``.

    A request inside another one adds to the outer one. A new thread starts outside of all requests.
    """
    if _seconds.get() is not None:
        yield
        return
    token = _seconds.set(dict.fromkeys(STAGES, 0.0))
    try:
        yield
    finally:
        _seconds.reset(token)


@contextmanager
def stage(name: Stage) -> Iterator[None]:
    """Add the duration of the block to a stage of the request, also if the block raises an error.

    Outside of a request the block runs unmeasured.

    Args:
        name: stage that the block belongs to.
    """
    started = perf_counter()
    try:
        yield
    finally:
        seconds = _seconds.get()
        if seconds is not None:
            seconds[name] += perf_counter() - started


def durations_ms() -> dict[Stage, float]:
    """Return the duration of each stage of the request so far, milliseconds; 0 for all outside of a request."""
    seconds = _seconds.get() or dict.fromkeys(STAGES, 0.0)
    return {name: 1e3 * seconds[name] for name in STAGES}
