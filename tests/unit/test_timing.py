import itertools
import threading

import pytest

from service import timing
from service.timing import STAGES, durations_ms, stage, timed_request

NOTHING = dict.fromkeys(STAGES, 0.0)


@pytest.fixture
def clock(monkeypatch):
    """Replace the clock by one of whole seconds. Every block takes one second."""
    monkeypatch.setattr(timing, "perf_counter", itertools.count().__next__)


@pytest.mark.usefixtures("clock")
def test_blocks_of_one_stage_add_up():
    with timed_request():
        for name in ("fuse", "search", "fuse"):
            with stage(name):
                pass
        assert durations_ms() == NOTHING | {"fuse": 2000, "search": 1000}


@pytest.mark.usefixtures("clock")
def test_a_block_that_fails_counts():
    with timed_request():
        with pytest.raises(ZeroDivisionError), stage("encode"):
            1 / 0  # noqa: B018
        assert durations_ms()["encode"] == 1000


@pytest.mark.usefixtures("clock")
def test_a_request_inside_another_adds_to_the_outer_one():
    @timed_request()
    def inner():
        with stage("fuse"):
            pass

    with timed_request():
        inner()
        inner()
        assert durations_ms()["fuse"] == 2000


@pytest.mark.usefixtures("clock")
def test_each_request_starts_at_zero_even_after_one_that_failed():
    with pytest.raises(ZeroDivisionError), timed_request(), stage("fuse"):
        1 / 0  # noqa: B018
    with timed_request():
        assert durations_ms() == NOTHING


def test_nothing_is_measured_outside_of_a_request():
    with stage("fuse"):
        pass
    assert durations_ms() == NOTHING


def test_concurrent_requests_share_no_durations():
    both_run, found = threading.Barrier(2), {}

    @timed_request()
    def request(name):
        with stage(name):
            both_run.wait(timeout=10)
        both_run.wait(timeout=10)
        found[name] = {each for each, ms in durations_ms().items() if ms > 0}

    threads = [threading.Thread(target=request, args=(name,)) for name in ("fuse", "encode")]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == {"fuse": {"fuse"}, "encode": {"encode"}}
