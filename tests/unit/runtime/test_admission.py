import gc
import threading
import time
import weakref
from collections.abc import Iterator
from concurrent.futures import CancelledError, Future

import numpy as np
import pytest

from service.errors import BusyError, RequestError, TooLargeError
from service.runtime.admission import Admission, MemoryBudget


@pytest.fixture
def blocked() -> Iterator[tuple[Admission, threading.Event]]:
    """Block the only worker until the event is set, with one slot in the queue."""
    admission, release, running = Admission(threads=1, queue=1), threading.Event(), threading.Event()

    def hold() -> None:
        running.set()
        release.wait(30)

    admission.submit(hold)
    assert running.wait(30)
    yield admission, release
    release.set()
    admission.close()


def test_a_task_gives_its_result() -> None:
    admission = Admission(threads=1, queue=0)
    assert admission.submit(lambda: 7).result(30) == 7
    admission.close()


def test_a_tasks_error_is_its_futures() -> None:
    admission = Admission(threads=1, queue=0)
    with pytest.raises(ZeroDivisionError):
        admission.submit(lambda: 1 // 0).result(30)
    admission.close()


def test_beyond_the_queue_a_task_is_refused_at_once(blocked: tuple[Admission, threading.Event]) -> None:
    admission, _ = blocked
    admission.submit(lambda: None)
    with pytest.raises(BusyError, match="2 requests"):
        admission.submit(lambda: None)


def test_a_cancelled_task_gives_its_place_back_and_never_runs(blocked: tuple[Admission, threading.Event]) -> None:
    admission, release = blocked
    ran: list[int] = []
    waiting = admission.submit(lambda: ran.append(1))
    assert waiting.cancel()
    after = admission.submit(lambda: ran.append(2))
    release.set()
    after.result(30)
    assert ran == [2]
    with pytest.raises(CancelledError):
        waiting.result()


def test_all_places_are_free_again_when_all_is_done() -> None:
    admission = Admission(threads=2, queue=1)
    for _ in range(20):
        for future in [admission.submit(lambda: None) for _ in range(3)]:
            future.result(30)
        # A place is given back by a callback, a moment after the result.
        until = time.monotonic() + 30
        while (admission.working, admission.waiting) != (0, 0):
            assert time.monotonic() < until
            time.sleep(0.001)
    admission.close()


def test_a_request_cancelled_in_the_queue_is_freed(blocked: tuple[Admission, threading.Event]) -> None:
    """Its slot and its memory are free at once, although the queue of the pool still holds it."""
    admission, _ = blocked

    class Pictures:
        pass

    def waiting_for(pictures: Pictures) -> "Future[Pictures]":
        return admission.submit(lambda: pictures)

    pictures = Pictures()
    gone = weakref.ref(pictures)
    future = waiting_for(pictures)
    del pictures
    assert gone() is not None
    assert future.cancel()
    del future
    gc.collect()
    assert gone() is None


def test_a_closed_pool_refuses() -> None:
    admission = Admission(threads=1, queue=0)
    admission.close()
    with pytest.raises(BusyError, match="the service is stopping"):
        admission.submit(lambda: None)


def test_a_request_that_does_not_fit_now_is_busy_and_one_that_never_fits_is_too_large() -> None:
    budget = MemoryBudget(10)
    with budget.hold() as one, budget.hold() as other:
        one.grow(6)
        with pytest.raises(BusyError):
            other.grow(5)
        other.grow(4)
        with pytest.raises(TooLargeError):
            one.grow(5)
        assert (one.bytes, other.bytes, budget.held) == (6, 4, 10)
        one.shrink_to(1)
        other.grow(5)
    assert budget.held == 0


def test_work_that_goes_on_after_its_caller_keeps_its_memory() -> None:
    budget, first, second = MemoryBudget(10), Future[None](), Future[None]()
    with budget.hold() as hold:
        hold.grow(6)
        hold.until(first)
        hold.until(second)
    assert budget.held == 6
    second.cancel()
    assert budget.held == 6
    first.set_result(None)
    assert budget.held == 0


def test_the_memory_left_to_an_image_is_freed_with_it() -> None:
    budget, picture = MemoryBudget(10), np.zeros(3)
    with budget.hold() as hold:
        hold.grow(6)
        hold.leave_with(picture)
    assert budget.held == 6
    view = picture
    del picture
    assert budget.held == 6
    del view
    assert budget.held == 0


def test_a_part_of_the_memory_can_be_left_to_an_object() -> None:
    budget, picture = MemoryBudget(10), np.zeros(3)
    with budget.hold() as hold:
        hold.grow(6)
        hold.leave_with(picture, 4)
        assert (hold.bytes, budget.held) == (2, 6)
    assert budget.held == 4
    del picture
    assert budget.held == 0


def test_watchers_receive_every_change() -> None:
    budget, told = MemoryBudget(10), list[float]()
    budget.watch(told.append)
    with budget.hold() as hold:
        hold.grow(6)
        hold.shrink_to(2)
    assert told == [0, 6, 2, 0]


def test_an_error_keeps_nothing_of_the_work_that_raised_it() -> None:
    class Picture:
        pass

    gone = list[bool]()

    def work() -> None:
        picture = Picture()
        weakref.finalize(picture, gone.append, True)
        try:
            raise ValueError("inner")
        except ValueError as error:
            raise RequestError("outer") from error

    admission = Admission(threads=1, queue=1)
    gc.disable()
    try:
        future = admission.submit(work)
        with pytest.raises(RequestError):
            future.result()
        assert gone == [True]
    finally:
        gc.enable()
        admission.close()
