"""Expected work in the background. No test depends on time: the first item waits until the test lets it go on."""

import threading
from collections.abc import Callable

import pytest

from service.errors import BundleError
from service.maps import ahead as module
from service.maps.ahead import Ahead

LAST = -1


class Work:
    """Records the items. Item 0 waits for ``go``, and the item ``LAST`` tells that it was done."""

    def __init__(self, fails: Callable[[int], Exception | None] = lambda _: None) -> None:
        self.done: list[int] = []
        self.begun, self.go, self.ended = threading.Event(), threading.Event(), threading.Event()
        self._fails = fails
        self.ahead = Ahead(self)

    def __call__(self, item: int) -> None:
        self.done.append(item)
        if item == 0:
            self.begun.set()
            assert self.go.wait(60)
        if item == LAST:
            self.ended.set()
        if (error := self._fails(item)) is not None:
            raise error

    def begin(self) -> None:
        """Let the thread begin with item 0, so that all others wait."""
        self.ahead.expect([0, LAST], is_ordered=True)
        assert self.begun.wait(60)

    def end(self) -> list[int]:
        """Let all work be done, and return the items without those of ``begin``."""
        self.go.set()
        assert self.ended.wait(60)
        return self.done[1:-1]


def test_expectations_of_several_robots_are_merged_the_newest_first() -> None:
    work = Work()
    work.begin()
    work.ahead.expect([1, 2, 3], is_ordered=True)
    work.ahead.expect([4, 2], is_ordered=True)
    assert work.ahead.waiting == (4, 2, 1, 3, LAST)
    assert work.end() == [4, 2, 1, 3]


def test_no_item_waits_twice_and_the_current_one_does_not_wait() -> None:
    work = Work()
    work.begin()
    work.ahead.expect([0, 5, 5, 6], is_ordered=True)
    work.ahead.expect([6, 0], is_ordered=True)
    assert work.end() == [6, 5]


def test_an_expectation_without_order_moves_only_what_is_new() -> None:
    work = Work()
    work.begin()
    work.ahead.expect([1, 2, 3], is_ordered=True)
    work.ahead.expect([3, 0, 2], is_ordered=False)
    assert work.ahead.waiting == (1, 2, 3, LAST)
    work.ahead.expect([3, 7], is_ordered=False)
    assert work.end() == [3, 7, 1, 2]


def test_the_oldest_items_are_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MOST_WAITING", 3)
    work = Work()
    work.begin()
    work.ahead.expect([1, 2], is_ordered=True)
    work.ahead.expect([3, 4], is_ordered=True)
    assert work.ahead.waiting == (3, 4, 1)
    work.ahead.expect([5, 6, LAST], is_ordered=True)
    assert work.ahead.waiting == (5, 6, LAST)
    assert work.end() == [5, 6]


def test_an_error_does_not_stop_the_others() -> None:
    errors = {1: BundleError("damaged"), 2: FileNotFoundError("gone")}
    work = Work(errors.get)
    work.begin()
    work.ahead.expect([1, 2, 3], is_ordered=True)
    assert work.end() == [1, 2, 3]


def test_one_thread_works_and_a_later_expectation_starts_it_again() -> None:
    for _ in range(2):
        before = threading.active_count()
        work = Work()
        work.begin()
        work.ahead.expect([1, 2], is_ordered=True)
        assert threading.active_count() == before + 1
        thread = next(each for each in threading.enumerate() if each.name == "open tiles ahead")
        assert work.end() == [1, 2]
        thread.join(60)
        work.ended.clear()
        work.ahead.expect([3, LAST], is_ordered=True)
        assert work.ended.wait(60)
        assert work.done[-2:] == [3, LAST]


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_work_goes_on_after_a_defect() -> None:
    work = Work(lambda item: ZeroDivisionError() if item == 0 else None)
    work.begin()
    thread = next(each for each in threading.enumerate() if each.name == "open tiles ahead")
    work.go.set()
    thread.join(60)
    assert work.ahead.waiting == (LAST,)
    work.ahead.expect([8], is_ordered=True)
    assert work.end() == [8]
