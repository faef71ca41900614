"""When to ask again: by the service's own advice, within a budget of attempts and time."""

import random
import time
from collections.abc import Callable
from dataclasses import dataclass

from service.errors import RequestError, StreetfixError, UnavailableError, UnreachableError


@dataclass(frozen=True, slots=True)
class RetryPolicy:
    """A caller's patience.

    Attributes:
        attempts: at most, the first among them; 1 never asks again.
        total_s: no attempt begins later than this after the first.
        backoff_s: before the second attempt where the service gave no advice, doubled before each further one.
        jitter: share of a wait by which it is drawn out at random, so that robots that were refused together do not come back together.
    """

    attempts: int = 4
    total_s: float = 20.0
    backoff_s: float = 0.2
    jitter: float = 0.25

    def __post_init__(self) -> None:
        """Refuse what is no patience.

        Raises:
            RequestError: a number is out of bounds.
        """
        if self.attempts < 1:
            raise RequestError(f"attempts: {self.attempts} asks nobody; give 1 or more", field="attempts")
        for name in ("total_s", "backoff_s", "jitter"):
            if not 0 <= getattr(self, name) < float("inf"):
                raise RequestError(f"{name}: {getattr(self, name)} is no patience; give 0 or more", field=name)


@dataclass(slots=True)
class Attempts:
    """The attempts of one call.

    Args:
        policy: the caller's patience.
        clock: monotonic seconds.
        draw: a random number in [0, 1).
    """

    policy: RetryPolicy
    clock: Callable[[], float] = time.monotonic
    draw: Callable[[], float] = random.random
    _made: int = 1
    _began_s: float = 0.0

    def __post_init__(self) -> None:
        """Let the time begin."""
        self._began_s = self.clock()

    def wait_after(self, error: StreetfixError) -> float:
        """Seconds to wait before the next attempt.

        Args:
            error: what the last attempt met.

        Raises:
            StreetfixError: the error itself, where asking again is of no use, or patience has ended.
        """
        wait_s = self._advised_s(error)
        if wait_s is None or self._made >= self.policy.attempts:
            raise error
        wait_s *= 1.0 + self.policy.jitter * self.draw()
        if self.clock() - self._began_s + wait_s > self.policy.total_s:
            raise error
        self._made += 1
        return wait_s

    def _advised_s(self, error: StreetfixError) -> float | None:
        own_s: float = self.policy.backoff_s * 2 ** (self._made - 1)
        if isinstance(error, UnavailableError):
            return own_s if error.retry_after_s is None else error.retry_after_s
        # A connection that fails says nothing of the request, and every call only asks. What took too long would take long again.
        return own_s if type(error) is UnreachableError else None
