"""Decide when to retry: as the service advises, within a budget of attempts and time."""

import random
import time
from collections.abc import Callable
from dataclasses import dataclass

from service.errors import RequestError, StreetfixError, UnavailableError, UnreachableError


@dataclass(frozen=True, slots=True)
class RetryPolicy:
    """Limits of the retries of one call.

    Attributes:
        attempts: maximum number of attempts, including the first. 1 never retries.
        total_s: latest start of an attempt, seconds after the call began.
        backoff_s: wait before the second attempt if the service gives no advice, seconds. It doubles before each further
            attempt.
        jitter: largest random extension of a wait, as a share of the wait. It spreads the retries of robots that were refused
            at the same time.
    """

    attempts: int = 4
    total_s: float = 20.0
    backoff_s: float = 0.2
    jitter: float = 0.25

    def __post_init__(self) -> None:
        """Check that all numbers are within bounds.

        Raises:
            RequestError: a number is out of bounds.
        """
        if self.attempts < 1:
            raise RequestError(
                f"attempts: {self.attempts} is not a valid number of attempts; pass 1 or more", field="attempts"
            )
        for name in ("total_s", "backoff_s", "jitter"):
            if not 0 <= getattr(self, name) < float("inf"):
                raise RequestError(f"{name}: {getattr(self, name)} is out of bounds; pass 0 or more", field=name)


@dataclass(slots=True)
class Attempts:
    """Counter of the attempts of one call.

    Args:
        policy: limits of the retries.
        clock: function that returns monotonic seconds.
        draw: function that returns a random number in [0, 1).
    """

    policy: RetryPolicy
    clock: Callable[[], float] = time.monotonic
    draw: Callable[[], float] = random.random
    _made: int = 1
    _began_s: float = 0.0

    def __post_init__(self) -> None:
        """Start the clock of the call."""
        self._began_s = self.clock()

    def wait_after(self, error: StreetfixError) -> float:
        """Return the wait before the next attempt, seconds.

        Args:
            error: error of the last attempt.

        Raises:
            StreetfixError: the given error, if a retry cannot help or the budget is used up.
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
        # A failed connection is worth a retry, because no call changes the service. The subclasses, such as
        # NoAnswerInTimeError, are not: a request that took too long would take long again.
        return own_s if type(error) is UnreachableError else None
