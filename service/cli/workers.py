"""``streetfix serve --workers N``: the supervisor starts, restarts and stops worker processes.

Only the main loop of the supervisor changes its list of workers. Signal handlers do nothing: the interpreter writes the number
of each signal into a pipe, and the loop reads it. So no handler can run between ``fork`` and the entry of the new process in the
list, or between ``waitpid`` and the removal of the ended one.
"""

import ctypes
import os
import select
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial

import typer

from service.errors import StreetfixError

#: Seconds before a worker that ended by itself is started again. If it ends again within ``STEADY_S``, the wait doubles, up to
#: ``MOST_RESTART_S``. So a worker that always ends at once does not keep the machine busy.
RESTART_S, MOST_RESTART_S, STEADY_S = 1.0, 30.0, 10.0
_PR_SET_PDEATHSIG = 1
_STOPPING = (signal.SIGTERM, signal.SIGINT)
_WATCHED = (*_STOPPING, signal.SIGHUP, signal.SIGCHLD)
#: Exit codes of a worker that was asked to stop: it ended by itself, or by the signal before it had a handler.
_AS_TOLD = (0, -signal.SIGTERM, -signal.SIGINT)
Work = Callable[[int, Callable[[], None]], None]


def supervise(
    count: int, work: Work, *, ended: Callable[[int], None] = lambda _: None, kill_after_s: float | None = None
) -> int:
    """Run workers until SIGTERM or SIGINT, and pass SIGHUP on to all of them.

    Call it in the main thread, before anything starts threads, because workers are forked.

    Args:
        count: number of workers, at most 256.
        work: runs in a worker. It gets the number of the worker and a function to call once it answers requests. It returns when
            the worker was asked to stop. SIGHUP is blocked at the call; it must unblock SIGHUP once it has a handler.
        ended: called with the process id of every worker that has ended.
        kill_after_s: seconds after the request to stop, after which running workers are killed; None waits without limit.

    Returns:
        The exit code. It is 1 if a worker ended before it ever answered, ended with an error after the request to stop, or had to be
        killed.
    """
    with _signals_as_bytes() as signals:
        return _Supervisor(count, work, signals, ended, kill_after_s).run()


class _Supervisor:
    def __init__(
        self, count: int, work: Work, signals: int, ended: Callable[[int], None], kill_after_s: float | None
    ) -> None:
        self._work, self._signals, self._ended, self._kill_after_s = work, signals, ended, kill_after_s
        self._ready, self._tell_ready = os.pipe()
        os.set_blocking(self._ready, False)
        self._running: dict[int, int] = {}  # process id -> number of the worker
        self._due = dict.fromkeys(range(count), 0.0)  # number of a worker to start -> when
        self._started: dict[int, float] = {}  # number of a worker -> time of its last start
        self._wait_s: dict[int, float] = {}  # number of a worker -> wait before its last start
        self._answered: set[int] = set()
        self._stopping = False
        self._kill_at: float | None = None
        self._code = 0

    def run(self) -> int:
        try:
            while self._running or self._due:
                self._start_what_is_due()
                select.select([self._signals], [], [], self._patience_s())
                received = _bytes(self._signals)
                if signal.SIGCHLD in received:
                    self._reap()
                if signal.SIGHUP in received:
                    self._pass_on(signal.SIGHUP)
                for number in _STOPPING:
                    if number in received:
                        self._stop(number)
                if self._kill_at is not None and time.monotonic() >= self._kill_at:
                    self._kill()
            return self._code
        except BaseException:  # a defect must not leave workers behind
            self._stop(signal.SIGTERM)
            raise
        finally:
            os.close(self._ready)
            os.close(self._tell_ready)

    def _start_what_is_due(self) -> None:
        now = time.monotonic()
        for number in [each for each, at in self._due.items() if at <= now]:
            if self._due.pop(number, None) is None:  # an earlier worker could not be started, so the service ends
                return
            self._started[number] = now
            try:
                self._running[_forked(number, self._work, self._tell_ready)] = number
            except OSError as error:  # the system cannot create another process
                typer.echo(f"streetfix: worker {number} cannot be started ({error.strerror})", err=True)
                self._not_running(number)

    def _patience_s(self) -> float | None:
        """Seconds until the next start or kill is due; None if there is none."""
        moments = [*self._due.values(), *([] if self._kill_at is None else [self._kill_at])]
        return max(0.0, min(moments) - time.monotonic()) if moments else None

    def _reap(self) -> None:
        while self._running:
            pid, status = os.waitpid(-1, os.WNOHANG)
            if pid == 0:
                return
            if pid not in self._running:  # a child process that other code started
                continue
            number, code = self._running.pop(pid), os.waitstatus_to_exitcode(status)
            self._answered.update(_bytes(self._ready))
            self._ended(pid)
            if self._stopping:
                self._code = self._code or int(code not in _AS_TOLD)
            else:
                if number in self._answered:
                    how = signal.Signals(-code).name if code < 0 else f"exit code {code}"
                    typer.echo(f"streetfix: worker {number} ended unexpectedly and is started again ({how})", err=True)
                self._not_running(number)

    def _not_running(self, number: int) -> None:
        """Schedule a restart of a worker if it ever answered; else end the service."""
        if number in self._answered:
            now = time.monotonic()
            was_steady = now - self._started[number] >= STEADY_S
            wait_s = RESTART_S if was_steady else min(2 * self._wait_s.get(number, RESTART_S / 2), MOST_RESTART_S)
            self._wait_s[number], self._due[number] = wait_s, now + wait_s
        else:
            self._code = 1
            self._stop(signal.SIGTERM)

    def _stop(self, number: int) -> None:
        """Begin to stop: start no more workers, and ask all of them to stop."""
        self._stopping = True
        self._due.clear()
        if self._kill_at is None and self._kill_after_s is not None:
            self._kill_at = time.monotonic() + self._kill_after_s
        self._pass_on(number)

    def _pass_on(self, number: int) -> None:
        for pid in self._running:  # none was reaped, so each id still belongs to the worker
            os.kill(pid, number)

    def _kill(self) -> None:
        typer.echo("streetfix: workers that did not stop are killed", err=True)
        self._kill_at, self._kill_after_s, self._code = None, None, 1
        for pid in self._running:
            os.kill(pid, signal.SIGKILL)


@contextmanager
def _signals_as_bytes() -> Iterator[int]:
    """Provide a pipe with one byte, the signal number, per received signal."""
    read, write = os.pipe()
    for end in (read, write):
        os.set_blocking(end, False)
    wakeup = signal.set_wakeup_fd(write, warn_on_full_buffer=False)
    before = {number: signal.signal(number, lambda *_: None) for number in _WATCHED}
    try:
        yield read
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        signal.set_wakeup_fd(wakeup)
        os.close(read)
        os.close(write)


def _forked(number: int, work: Work, tell_ready: int) -> int:
    """Start a worker; return its process id."""
    parent = os.getpid()
    # Block signals until the child has its own handlers. Before that they would go into the pipe of the parent and be lost.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _WATCHED)
    try:
        pid = os.fork()
        if pid:
            return pid
    finally:
        if os.getpid() == parent:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
    code = 1
    try:
        signal.set_wakeup_fd(-1)
        for each in _WATCHED:
            signal.signal(each, signal.SIG_DFL)
        os.setpgid(0, 0)  # Ctrl-C in a terminal reaches only the parent, which passes it on
        _die_with_the_parent(parent)
        # By default SIGHUP would end a worker that has no handler yet.
        signal.pthread_sigmask(signal.SIG_SETMASK, {*before, signal.SIGHUP})
        work(number, partial(_write, tell_ready, number))
        code = 0
    except StreetfixError as error:
        typer.echo(f"streetfix: {error.message}", err=True)
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def _write(pipe: int, number: int) -> None:
    os.write(pipe, bytes([number]))


def _bytes(pipe: int) -> bytes:
    try:
        return os.read(pipe, 65536)
    except BlockingIOError:
        return b""


def _die_with_the_parent(parent: int) -> None:
    """On Linux, stop the worker if its parent is killed. On other systems it runs until it gets a signal."""
    prctl = getattr(ctypes.CDLL(None), "prctl", None)
    if prctl is None:
        return
    prctl(_PR_SET_PDEATHSIG, int(signal.SIGTERM), 0, 0, 0)
    if os.getppid() != parent:  # the parent was killed before prctl took effect
        os.kill(os.getpid(), signal.SIGTERM)
