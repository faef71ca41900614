"""A process of a training notices that another one was lost. Two ends of a connection stand for two processes."""

import socket
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from model_training.training.watch import Watch, connect

#: Longest wait on a busy machine, seconds.
PATIENCE_S = 60


class Lost:
    """Keeps the reason that a watch gives."""

    def __init__(self):
        self.reason, self.called = "", threading.Event()

    def __call__(self, reason):
        self.reason = reason
        self.called.set()


class Keys:
    """A key store whose ``get`` waits until the key is there, like that of torch."""

    def __init__(self):
        self._values, self._changed = {}, threading.Condition()

    def set(self, key, value, /):
        with self._changed:
            self._values[key] = value.encode()
            self._changed.notify_all()

    def get(self, key, /):
        with self._changed:
            assert self._changed.wait_for(lambda: key in self._values, PATIENCE_S)
            return self._values[key]


def ended(watch: Watch) -> bool:
    watch._thread.join(PATIENCE_S)
    return not watch._thread.is_alive()


def test_a_silent_process_is_lost():
    """The other process keeps its connection but sends nothing, like a machine without power."""
    own, silent = socket.socketpair()
    lost = Lost()
    watch = Watch([own], lost, every_s=0.01, silent_s=0.2, grace_s=0)
    assert lost.called.wait(PATIENCE_S)
    assert lost.reason == "another training process has been silent for 0 s"
    watch.leave(failed=True)
    silent.close()


def test_a_process_that_sends_is_not_lost():
    own, other = socket.socketpair()
    lost = Lost()
    watch = Watch([own], lost, every_s=0.01, silent_s=PATIENCE_S, grace_s=0)
    for _ in range(3):
        other.sendall(b"r")
        assert other.recv(1) == b"r"
    watch.leave(failed=False)
    while (last := other.recv(4096)) and last[-1:] == b"r":
        pass
    assert last[-1:] == b"d"
    assert not lost.called.is_set()
    other.close()


def test_a_killed_process_is_lost_at_once():
    own, other = socket.socketpair()
    lost = Lost()
    watch = Watch([own], lost, grace_s=0)  # the limit of silence is two minutes
    other.close()
    assert lost.called.wait(PATIENCE_S)
    assert lost.reason.startswith(
        "another training process was lost ("
    )  # closed, or reset if there was something to read
    watch.leave(failed=True)


def test_a_process_that_fails_ends_the_others():
    own, other = socket.socketpair()
    lost, lost_of_failing = Lost(), Lost()
    watch = Watch([own], lost, grace_s=0)
    Watch([other], lost_of_failing).leave(failed=True)
    assert lost.called.wait(PATIENCE_S)
    assert lost.reason == "another training process has failed"
    assert not lost_of_failing.called.is_set()
    watch.leave(failed=True)


def test_a_process_that_reports_the_same_error_ends_by_itself():
    own, other = socket.socketpair()
    lost = Lost()
    watch = Watch([own], lost, grace_s=PATIENCE_S)
    Watch([other], lost).leave(failed=True)
    watch.leave(failed=True)
    assert not lost.called.is_set()


def test_a_finished_process_ends_the_watch_of_the_others():
    own, other = socket.socketpair()
    lost = Lost()
    watch = Watch([own], lost, grace_s=0)
    Watch([other], lost).leave(failed=False)
    assert ended(watch)
    watch.leave(failed=False)
    assert not lost.called.is_set()


def test_the_first_process_watches_the_others_after_one_has_finished():
    (to_second, second), (to_third, third) = socket.socketpair(), socket.socketpair()
    lost = Lost()
    watch = Watch([to_second, to_third], lost, every_s=0.01, grace_s=0)
    second.sendall(b"d")
    second.close()
    third.close()
    assert lost.called.wait(PATIENCE_S)
    assert lost.reason.startswith("another training process was lost (")
    watch.leave(failed=True)


def test_the_first_process_tells_the_others_at_once_that_one_was_lost():
    """It does not wait until it ends itself: otherwise the others would end twice the time of grace after the loss."""
    (to_second, second), (to_third, third) = socket.socketpair(), socket.socketpair()
    lost, lost_of_third = Lost(), Lost()
    watch = Watch([to_second, to_third], lost, grace_s=10 * PATIENCE_S)
    watch_of_third = Watch([third], lost_of_third, grace_s=0)
    second.close()
    assert lost_of_third.called.wait(PATIENCE_S)
    assert lost_of_third.reason == "another training process has failed"
    watch.leave(failed=True)
    watch_of_third.leave(failed=True)
    assert not lost.called.is_set()


def test_all_processes_are_connected_to_the_first_one_and_strangers_are_not():
    keys, stranger = Keys(), socket.socket()

    def disturb():
        port = int(keys.get("watch").split()[0])
        stranger.connect(("127.0.0.1", port))
        stranger.sendall(bytes(16))

    def own(rank):
        if rank == 1:
            disturb()
        return connect(keys, rank, 3, "localhost", within_s=PATIENCE_S)

    with ThreadPoolExecutor(3) as pool:
        first, *others = pool.map(own, range(3))
    assert [len(others[0]), len(others[1]), len(first)] == [1, 1, 2]
    others[0][0].sendall(b"1")
    others[1][0].sendall(b"2")
    assert {one.recv(1) for one in first} == {b"1", b"2"}
    assert stranger.recv(1) == b""
    for one in (*first, *others[0], *others[1], stranger):
        one.close()


def test_strangers_do_not_prolong_the_time_to_connect():
    """One comes after the other, each with a wrong password."""
    keys, ended = Keys(), threading.Event()

    def disturb():
        port = int(keys.get("watch").split()[0])
        while not ended.wait(0.05):
            try:
                with socket.create_connection(("127.0.0.1", port), 1) as stranger:
                    stranger.sendall(bytes(16))
            except OSError:
                return  # nobody listens any more

    with ThreadPoolExecutor(2) as pool:
        disturbing = pool.submit(disturb)
        first = pool.submit(connect, keys, 0, 2, "localhost", within_s=0.3)
        try:
            with pytest.raises(TimeoutError, match=r"timed out|1 of 2 training processes connected within 0\.3 s"):
                first.result(PATIENCE_S)
        finally:
            ended.set()
        disturbing.result(PATIENCE_S)


def test_a_process_that_does_not_connect_in_time_is_an_error():
    with pytest.raises(TimeoutError):
        connect(Keys(), 0, 2, "localhost", within_s=0.05)
