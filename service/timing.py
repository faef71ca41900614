"""The stages of a request, and a timer that sums their durations."""

from collections.abc import Iterator
from contextlib import contextmanager
from time import perf_counter
from typing import Literal, get_args

Stage = Literal["decode", "fuse", "encode", "search", "register"]
#: All stages, in their order. ``service.localization.answer.Timings`` says what each contains.
STAGES: tuple[Stage, ...] = get_args(Stage)


class StageTimer:
    """Durations of the stages of one request. Every request has its own timer. It is not thread-safe."""

    def __init__(self) -> None:
        self._seconds = dict.fromkeys(STAGES, 0.0)

    @contextmanager
    def stage(self, stage: Stage) -> Iterator[None]:
        """Add the duration of the block to a stage, also if the block raises an error.

        Args:
            stage: stage that the block belongs to.
        """
        started = perf_counter()
        try:
            yield
        finally:
            self._seconds[stage] += perf_counter() - started

    def ms(self, stage: Stage) -> float:
        """Return the duration of a stage so far, milliseconds.

        Args:
            stage: one of ``STAGES``.
        """
        return 1e3 * self._seconds[stage]

    @property
    def total_ms(self) -> float:
        """Duration of all stages so far, milliseconds."""
        return 1e3 * sum(self._seconds.values())
