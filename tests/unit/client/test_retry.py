from typing import Any

import pytest

from service.client.retry import Attempts, RetryPolicy
from service.errors import (
    ForeignServiceError,
    NoAnswerInTimeError,
    RefusedError,
    RequestError,
    StreetfixError,
    UnavailableError,
    UnreachableError,
)


class Clock:
    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def busy(retry_after_s: float | None) -> UnavailableError:
    error = UnavailableError("busy")
    error.retry_after_s = retry_after_s
    return error


def attempts(clock: Clock | None = None, *, draw: float = 0.0, **policy: Any) -> Attempts:
    return Attempts(RetryPolicy(**policy), clock or Clock(), lambda: draw)


def test_the_services_advice_is_obeyed() -> None:
    assert attempts().wait_after(busy(3.0)) == 3.0


def test_jitter_only_draws_the_advice_out() -> None:
    assert attempts(draw=1.0, jitter=0.25).wait_after(busy(4.0)) == 5.0


def test_without_advice_the_waits_double() -> None:
    asked = attempts(backoff_s=0.5, attempts=4)
    assert [asked.wait_after(busy(None)) for _ in range(3)] == [0.5, 1.0, 2.0]


def test_a_lost_connection_is_tried_again() -> None:
    assert attempts(backoff_s=0.5).wait_after(UnreachableError("refused")) == 0.5


@pytest.mark.parametrize(
    "error", [RefusedError("no"), ForeignServiceError("html"), NoAnswerInTimeError("slow"), RequestError("bad")]
)
def test_a_permanent_failure_is_not_retried(error: StreetfixError) -> None:
    with pytest.raises(type(error)) as caught:
        attempts().wait_after(error)
    assert caught.value is error


def test_attempts_end() -> None:
    asked = attempts(attempts=3)
    asked.wait_after(busy(0.0))
    asked.wait_after(busy(0.0))
    with pytest.raises(UnavailableError):
        asked.wait_after(busy(0.0))


def test_one_attempt_is_never_repeated() -> None:
    with pytest.raises(UnavailableError):
        attempts(attempts=1).wait_after(busy(0.0))


def test_a_wait_beyond_the_budget_is_not_begun() -> None:
    clock = Clock()
    asked = attempts(clock, total_s=10.0)
    clock.now_s += 8.0
    assert asked.wait_after(busy(2.0)) == 2.0
    with pytest.raises(UnavailableError):
        asked.wait_after(busy(2.5))


@pytest.mark.parametrize("wrong", [{"attempts": 0}, {"total_s": -1.0}, {"backoff_s": float("nan")}, {"jitter": -0.1}])
def test_an_invalid_patience_is_refused_by_name(wrong: dict[str, Any]) -> None:
    (name,) = wrong
    with pytest.raises(RequestError, match=f"^{name}: ") as caught:
        RetryPolicy(**wrong)
    assert caught.value.field == name
