"""A process of a training notices that another one was lost. Two groups in one process stand for two processes."""

import threading
from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta

import pytest

torch = pytest.importorskip("torch", reason="needs the extra `training`")

from torch._C._distributed_c10d import HashStore  # noqa: E402  # after the skip
from torch.distributed import ProcessGroupGloo  # noqa: E402

from model_training.training.watch import Watch  # noqa: E402

#: Longest wait on a busy machine, seconds.
PATIENCE_S = 60


class Lost:
    """Keeps the reason that a watch gives."""

    def __init__(self):
        self.reason, self.called = "", threading.Event()

    def __call__(self, reason):
        self.reason = reason
        self.called.set()


def groups(silence_s: float = PATIENCE_S):
    store = HashStore()
    with ThreadPoolExecutor(2) as pool:
        return list(pool.map(lambda rank: ProcessGroupGloo(store, rank, 2, timedelta(seconds=silence_s)), range(2)))


def ended(watch: Watch) -> bool:
    watch._thread.join(PATIENCE_S)
    return not watch._thread.is_alive()


def test_a_silent_process_is_lost():
    """The other process has a group but asks nothing, like a machine without power."""
    own, _silent = groups(silence_s=0.3)
    lost = Lost()
    Watch(own, lost, every_s=0.01, grace_s=0.01)
    assert lost.called.wait(PATIENCE_S)
    assert lost.reason.startswith("another training process was lost (")


def test_a_process_that_fails_ends_the_others():
    own, other = groups()
    lost, lost_of_failing = Lost(), Lost()
    Watch(own, lost, every_s=0.01, grace_s=0.01)
    Watch(other, lost_of_failing, every_s=0.01).leave(failed=True)
    assert lost.called.wait(PATIENCE_S)
    assert lost.reason == "another training process has failed"
    assert not lost_of_failing.called.is_set()


def test_a_process_that_reports_the_same_error_ends_by_itself():
    own, other = groups()
    lost = Lost()
    watch = Watch(own, lost, every_s=0.01, grace_s=PATIENCE_S)
    Watch(other, lost, every_s=0.01).leave(failed=True)
    watch.leave(failed=True)
    assert ended(watch)
    assert not lost.called.is_set()


@pytest.mark.parametrize("failed", [False, True])
def test_a_process_that_leaves_after_the_other_was_lost_ends_by_itself(failed):
    own, _silent = groups(silence_s=0.1)
    lost = Lost()
    watch = Watch(own, lost, every_s=0.01, grace_s=PATIENCE_S)
    watch.leave(failed=failed)
    assert ended(watch)
    assert not lost.called.is_set()


def test_a_finished_process_ends_the_watch_of_the_others():
    own, other = groups()
    lost = Lost()
    watch = Watch(own, lost, every_s=0.01, grace_s=0.0)
    Watch(other, lost, every_s=0.01).leave(failed=False)
    assert ended(watch)
    watch.leave(failed=False)
    assert not lost.called.is_set()
