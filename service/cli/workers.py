"""``streetfix serve --workers N``: processes that answer on the same ports; maps are in memory once, since all map the same files."""

import ctypes
import os
import signal
import sys
import time
import traceback
from collections.abc import Callable
from functools import partial
from types import FrameType

import typer

from service.errors import StreetfixError

#: A worker that fell is started again after this long, so that one that falls at once does not keep the machine busy.
AGAIN_S = 1.0
_PR_SET_PDEATHSIG = 1
Work = Callable[[int, Callable[[], None]], None]


def supervise(count: int, work: Work, *, fell: Callable[[int], None] = lambda _: None) -> int:
    """Run workers until SIGTERM or SIGINT; SIGHUP is passed on to all of them.

    Must be called before anything that holds threads: workers are forked.

    Args:
        count: of workers.
        work: of one: its number, and what it calls when it answers. It returns when it was told to stop.
        fell: told the process of a worker that is no more.

    Returns:
        The exit code: 1 where a worker ended before it ever answered (it said why), or a worker ended badly when told to stop.
    """
    ready, told = os.pipe()
    os.set_blocking(ready, False)
    running: dict[int, int] = {}
    leaving, code = False, 0

    def pass_on(number: int, _frame: FrameType | None) -> None:
        nonlocal leaving
        leaving = leaving or number != signal.SIGHUP
        for pid in list(running):
            os.kill(pid, number)

    before = {number: signal.signal(number, pass_on) for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)}
    answered: set[int] = set()
    try:
        for number in range(count):
            running[_forked(number, work, told)] = number
        while running:
            pid, status = os.wait()
            number, ended = running.pop(pid), os.waitstatus_to_exitcode(status)
            answered.update(_bytes(ready))
            fell(pid)
            if leaving:
                code = code or int(
                    ended not in (0, -signal.SIGTERM)
                )  # a signal before it had a handler ends it as well
            elif number not in answered:
                code = 1
                pass_on(signal.SIGTERM, None)
            else:
                typer.echo(f"streetfix: worker {number} ended by itself and is started again", err=True)
                time.sleep(AGAIN_S)
                if not leaving:  # a signal may have come meanwhile
                    running[_forked(number, work, told)] = number
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        os.close(ready)
        os.close(told)
    return code


def _forked(number: int, work: Work, told: int) -> int:
    pid = os.fork()
    if pid:
        return pid
    code = 1
    try:
        os.setpgid(0, 0)  # Ctrl-C of a terminal reaches the parent alone, which passes it on
        _die_with_the_parent()
        for each in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
            signal.signal(each, signal.SIG_DFL)
        work(number, partial(_write, told, number))
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
        return os.read(pipe, 4096)
    except BlockingIOError:
        return b""


def _die_with_the_parent() -> None:
    """On Linux a worker whose parent was killed is told to stop; elsewhere it stays until it is told."""
    prctl = getattr(ctypes.CDLL(None), "prctl", None)
    if prctl is not None:
        prctl(_PR_SET_PDEATHSIG, int(signal.SIGTERM), 0, 0, 0)
