"""The supervisor of workers, with workers that do almost nothing. Each test runs it in its own process."""

import os
import random
import select
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

_SUPERVISOR = """
import os, signal, sys, time
from service.cli import workers

def say(line):
    os.write(1, f"{line}\\n".encode())  # in one piece, though several processes write

def stay(number, ready):
    signal.alarm(60)  # whatever a test does, nothing stays for ever
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGHUP})
    ready()
    while True:
        signal.pause()
"""


def run(code: str, *arguments: str) -> "subprocess.Popen[str]":
    return subprocess.Popen(
        [sys.executable, "-c", _SUPERVISOR + textwrap.dedent(code), *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


@pytest.fixture
def started() -> Iterator[list["subprocess.Popen[str]"]]:
    """Kill the whole session of every process that a test leaves running."""
    processes: list[subprocess.Popen[str]] = []
    yield processes
    for process in processes:
        if process.poll() is None:
            process.kill()
        process.communicate()


def test_sigterm_at_any_moment_ends_the_supervisor_and_all_workers(started: list["subprocess.Popen[str]"]) -> None:
    """Each round forks a supervisor and sends SIGTERM while it forks 2 to 16 workers."""
    process = run(
        """
        import random, select
        chance = random.Random(int(sys.argv[1]))
        for _ in range(int(sys.argv[2])):
            count = chance.choice((2, 4, 8, 16))
            alive, held = os.pipe()  # every worker inherits `held`: the end of `alive` says that none is left
            supervisor = os.fork()
            if supervisor == 0:
                os.close(alive)
                signal.signal(signal.SIGTERM, signal.SIG_DFL)
                os._exit(workers.supervise(count, stay))
            os.close(held)
            time.sleep(chance.uniform(0.0, 0.004 * count))
            os.kill(supervisor, signal.SIGTERM)
            ended, _, _ = select.select([alive], [], [], 20)
            assert ended, f"{count} workers still run"
            _, status = os.waitpid(supervisor, 0)
            # Before it had handlers SIGTERM ends it at once.
            assert os.waitstatus_to_exitcode(status) in (0, -signal.SIGTERM), status
            os.close(alive)
        """,
        str(random.randrange(2**32)),  # noqa: S311  # no secret
        "60",
    )
    started.append(process)
    _, told = process.communicate(timeout=300)
    assert (process.returncode, told) == (0, "")


def test_a_worker_that_ends_by_itself_is_started_again_and_no_ended_process_is_signalled(
    started: list["subprocess.Popen[str]"],
) -> None:
    process = run(
        """
        workers.RESTART_S = 0.0
        real, reaped = os.kill, set()
        def kill(pid, number):
            assert pid not in reaped, f"{pid} was reaped and is signalled"
            real(pid, number)
        os.kill = kill
        def work(number, ready):
            ready()
            if number:
                time.sleep(0.001)  # falls again and again, while the supervisor is sent SIGHUP without pause
            else:
                signal.signal(signal.SIGHUP, lambda *_: None)
                stay(number, lambda: None)
        def ended(pid):
            reaped.add(pid)
            if len(reaped) == 40:
                print("forty", flush=True)
        def forked(*arguments, fork=workers._forked):
            pid = fork(*arguments)
            reaped.discard(pid)
            return pid
        workers._forked = forked
        print("begun", flush=True)
        sys.exit(workers.supervise(3, work, ended=ended))
        """
    )
    started.append(process)
    assert process.stdout is not None
    assert process.stdout.readline() == "begun\n"
    time.sleep(0.2)
    while not select.select([process.stdout], [], [], 0)[0]:
        process.send_signal(signal.SIGHUP)
    process.send_signal(signal.SIGTERM)
    out, told = process.communicate(timeout=60)
    assert (process.returncode, out) == (0, "forty\n"), told
    assert "is started again" in told
    assert "Traceback" not in told


def test_sighup_reaches_every_worker_even_while_it_starts(started: list["subprocess.Popen[str]"]) -> None:
    process = run(
        """
        def work(number, ready):
            say("starting")
            time.sleep(0.3)  # SIGHUP comes now, and must neither end it nor be lost
            signal.signal(signal.SIGHUP, lambda *_: say("hangup"))
            stay(number, ready)
        sys.exit(workers.supervise(2, work))
        """
    )
    started.append(process)
    assert process.stdout is not None
    for _ in range(2):
        assert process.stdout.readline() == "starting\n"
    process.send_signal(signal.SIGHUP)
    for _ in range(2):
        assert process.stdout.readline() == "hangup\n"
    process.send_signal(signal.SIGTERM)
    assert process.wait(60) == 0


@pytest.mark.parametrize(("end", "told"), [("raise ValueError('defect')", "defect"), ("sys.exit(0)", "")])
def test_a_worker_that_ends_before_it_answered_ends_all(
    started: list["subprocess.Popen[str]"], end: str, told: str
) -> None:
    process = run(
        f"""
        def work(number, ready):
            if number == 1:
                {end}
            stay(number, ready)
        sys.exit(workers.supervise(4, work))
        """
    )
    started.append(process)
    _, error = process.communicate(timeout=60)
    assert process.returncode == 1
    assert told in error


def test_a_worker_that_does_not_stop_is_killed(started: list["subprocess.Popen[str]"]) -> None:
    process = run(
        """
        def work(number, ready):
            signal.signal(signal.SIGTERM, signal.SIG_IGN)
            say("deaf")
            stay(number, ready)
        sys.exit(workers.supervise(2, work, kill_after_s=0.2))
        """
    )
    started.append(process)
    assert process.stdout is not None
    for _ in range(2):
        assert process.stdout.readline() == "deaf\n"
    process.send_signal(signal.SIGTERM)
    _, told = process.communicate(timeout=60)
    assert process.returncode == 1
    assert "killed" in told


def test_a_process_that_cannot_be_forked_ends_the_others(started: list["subprocess.Popen[str]"]) -> None:
    process = run(
        """
        real, calls = os.fork, []
        def fork():
            calls.append(0)
            if len(calls) == 3:
                raise BlockingIOError(11, "Resource temporarily unavailable")
            return real()
        os.fork = fork
        sys.exit(workers.supervise(4, stay))
        """
    )
    started.append(process)
    _, told = process.communicate(timeout=60)
    assert process.returncode == 1
    assert told == "streetfix: worker 2 cannot be started (Resource temporarily unavailable)\n"


def test_a_worker_that_ends_again_and_again_waits_longer_each_time(started: list["subprocess.Popen[str]"]) -> None:
    """The delays are the timeouts that the supervisor passes to ``select``. Here they end at once."""
    process = run(
        """
        import itertools, select
        clock, waits = [0.0], []
        workers.time.monotonic = lambda: clock[0]
        real = select.select
        def passing(readable, *rest):
            wait_s = rest[2]
            if wait_s:
                waits.append(wait_s)
                clock[0] += wait_s
                if len(waits) == 7:
                    print(*waits, flush=True)
                    os.kill(os.getpid(), signal.SIGTERM)
                wait_s = 0
            return real(readable, *rest[:2], wait_s)
        workers.select.select = passing
        def work(number, ready):
            ready()
            os._exit(1)
        workers.supervise(1, work)
        """
    )
    started.append(process)
    told, _ = process.communicate(timeout=60)
    assert [float(each) for each in told.split()] == [1, 2, 4, 8, 16, 30, 30]


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="only Linux tells a process that its parent has ended")
def test_workers_end_with_a_supervisor_that_is_killed(started: list["subprocess.Popen[str]"]) -> None:
    process = run(
        """
        def work(number, ready):
            say(os.getpid())
            stay(number, ready)
        workers.supervise(2, work)
        """
    )
    started.append(process)
    assert process.stdout is not None
    pids = [int(process.stdout.readline()) for _ in range(2)]
    process.kill()
    process.wait(30)
    until = time.monotonic() + 30
    while any(_runs(pid) for pid in pids):
        assert time.monotonic() < until
        os.sched_yield()


def _runs(pid: int) -> bool:
    """Return whether a process exists and is no zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
