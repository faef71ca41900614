import itertools

import pytest

from service import timing
from service.timing import STAGES, StageTimer


@pytest.fixture
def timer(monkeypatch):
    """Return a timer with a clock of whole seconds. Every block takes one second."""
    monkeypatch.setattr(timing, "perf_counter", itertools.count().__next__)
    return StageTimer()


def test_blocks_of_one_stage_add_up(timer):
    for stage in ("fuse", "search", "fuse"):
        with timer.stage(stage):
            pass
    assert {stage: timer.ms(stage) for stage in STAGES} == {
        "decode": 0,
        "fuse": 2000,
        "encode": 0,
        "search": 1000,
        "register": 0,
    }
    assert timer.total_ms == 3000


def test_a_block_that_fails_counts(timer):
    with pytest.raises(ZeroDivisionError), timer.stage("encode"):
        1 / 0  # noqa: B018
    assert timer.ms("encode") == 1000
