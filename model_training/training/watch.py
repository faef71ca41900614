"""Notice that a process of a training was lost.

The agents of torchrun do not tell each other that a machine was lost (https://github.com/pytorch/pytorch/issues/111646). A process that
waits for it in gloo or NCCL waits for minutes, even if the other process was killed (decision 0156). A process that waits for files of
another one would wait for ever. So each process is connected to the first one, and both send a byte every second.
"""

import secrets
import selectors
import socket
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from typing import Protocol

#: A process that sends nothing for so long is lost, seconds. Reading from a busy network drive keeps a process silent for some time.
LOST_AFTER_S = 120.0
#: Time between two bytes, seconds.
SEND_EVERY_S = 1.0
#: Time in which a process may end by itself after another has failed, seconds: perhaps it reports the same error.
GRACE_S = 10.0
#: Time that a new connection has to send the password, seconds.
_PASSWORD_WITHIN_S = 10.0
_PASSWORD_BYTES = 16
#: What a process sends: it runs, it has finished, or it ends because of an error.
_RUNS, _DONE, _FAILED = b"r", b"d", b"f"


class KeyStore(Protocol):
    """The part of a store of torch that a process needs."""

    def set(self, key: str, value: str, /) -> None:
        """Set a key."""

    def get(self, key: str, /) -> bytes:
        """Return the value of a key, after somebody has set it."""


def connect(store: KeyStore, rank: int, count: int, host: str, *, within_s: float) -> list[socket.socket]:
    """Connect all processes to the first one.

    Args:
        store: key store of the processes. The first process puts its port and a password there.
        rank: number of this process.
        count: number of processes.
        host: address of the machine of the first process.
        within_s: longest time until all processes are connected, seconds.

    Returns:
        In the first process the connections to all others, in another process that to the first one.

    Raises:
        OSError: the processes are not connected in time.
    """
    if rank > 0:
        port, password = store.get("watch").decode().split()
        connection = socket.create_connection((host, int(port)), timeout=within_s)
        connection.sendall(bytes.fromhex(password))
        return [_without_delay(connection)]
    both = socket.has_dualstack_ipv6()
    family = socket.AF_INET6 if both else socket.AF_INET
    connections: list[socket.socket] = []
    with socket.create_server(("", 0), family=family, dualstack_ipv6=both, backlog=count) as server:
        until = time.monotonic() + within_s
        expected = secrets.token_bytes(_PASSWORD_BYTES)
        store.set("watch", f"{server.getsockname()[1]} {expected.hex()}")
        while len(connections) < count - 1:
            left_s = until - time.monotonic()  # strangers do not prolong it
            if left_s <= 0:
                raise TimeoutError(
                    f"{len(connections) + 1} of {count} training processes connected within {within_s:g} s"
                )
            server.settimeout(left_s)
            connection, _ = server.accept()
            if secrets.compare_digest(_first_bytes(connection), expected):
                connections.append(_without_delay(connection))
            else:
                connection.close()  # a stranger, for example a port scanner
    return connections


def _without_delay(connection: socket.socket) -> socket.socket:
    """Make the system send each byte at once: the last one must not wait for an answer to the one before it.

    Args:
        connection: TCP connection.
    """
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return connection


def _first_bytes(connection: socket.socket) -> bytes:
    """Return the first bytes that a connection sends: ``_PASSWORD_BYTES``, or fewer if it sends no more in time."""
    connection.settimeout(_PASSWORD_WITHIN_S)
    received = b""
    try:
        while len(received) < _PASSWORD_BYTES and (more := connection.recv(_PASSWORD_BYTES - len(received))):
            received += more
    except OSError:
        return b""
    return received


class Watch:
    """A thread that sends a byte every second, and notices if another process stops sending.

    Args:
        connections: connections to other processes; the watch closes them.
        lost: called in the thread with the reason if another process fails or is lost, and this one does not leave within ``grace_s``.
        every_s: time between two bytes, seconds.
        silent_s: a process that sends nothing for so long is lost, seconds.
        grace_s: time in which this process may leave by itself, seconds.
    """

    def __init__(
        self,
        connections: Sequence[socket.socket],
        lost: Callable[[str], None],
        *,
        every_s: float = SEND_EVERY_S,
        silent_s: float = LOST_AFTER_S,
        grace_s: float = GRACE_S,
    ) -> None:
        self._connections, self._lost = list(connections), lost
        self._every_s, self._silent_s, self._grace_s = every_s, silent_s, grace_s
        self._state, self._left = _RUNS, threading.Event()
        self._wake, self._woken = socket.socketpair()
        self._thread = threading.Thread(target=self._run, name="watch", daemon=True)
        self._thread.start()

    def leave(self, *, failed: bool) -> None:
        """Tell the other processes that this one ends, and stop watching.

        Args:
            failed: this process ends because of an error. The others then end too.
        """
        self._state = _FAILED if failed else _DONE
        self._left.set()
        self._wake.send(b"w")
        self._thread.join()
        for one in (*self._connections, self._wake, self._woken):
            one.close()

    def _run(self) -> None:
        try:
            self._watch()
        except _LostError as lost:
            _send(self._connections, _FAILED)  # only the first process is connected to all others
            if not self._left.wait(self._grace_s):
                self._lost(str(lost))

    def _watch(self) -> None:
        """Send and receive until this process or all others leave.

        Raises:
            _LostError: another process fails or is lost.
        """
        heard = dict.fromkeys(self._connections, time.monotonic())
        with selectors.DefaultSelector() as selector:
            for one in (*heard, self._woken):
                one.settimeout(self._silent_s)
                selector.register(one, selectors.EVENT_READ, one)
            while heard and self._state == _RUNS:
                _send(heard, _RUNS)
                for key, _ in selector.select(self._every_s):
                    one = key.data
                    if one is self._woken:
                        continue
                    if _said(one) == _DONE:
                        selector.unregister(one)
                        del heard[one]
                    else:
                        heard[one] = time.monotonic()
                if heard and time.monotonic() - min(heard.values()) > self._silent_s:
                    raise _LostError(f"another training process has been silent for {self._silent_s:.0f} s")
            if self._state != _RUNS:
                _send(heard, self._state)


class _LostError(Exception):
    """Another process fails or is lost."""


def _send(connections: Iterable[socket.socket], state: bytes) -> None:
    for one in connections:
        with suppress(OSError):  # reading says why: the other process has finished, or was lost
            one.sendall(state)


def _said(connection: socket.socket) -> bytes:
    """Return the last state that another process has sent.

    Args:
        connection: connection with something to read.

    Raises:
        _LostError: the process fails, or has ended without a word.
    """
    try:
        received = connection.recv(4096)
    except OSError as error:
        raise _LostError(f"another training process was lost ({error.strerror or error})") from error
    if not received:
        raise _LostError("another training process was lost (it has closed its connection)")
    if received[-1:] == _FAILED:
        raise _LostError("another training process has failed")
    return received[-1:]
