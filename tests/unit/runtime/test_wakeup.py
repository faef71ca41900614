"""An event that a signal handler may set while another call sets it or waits for it."""

import subprocess
import sys
import threading

from service.runtime.wakeup import Wakeup

#: Two threads send signals as fast as they can while the main thread goes on; a handler that waits for a lock never ends.
STORM = """
import os, signal, sys, threading, time
from service.runtime.wakeup import Wakeup

event = {event}()
signal.signal(signal.SIGHUP, lambda *_: event.set())
over = time.monotonic() + 1.5

def storm():
    while time.monotonic() < over:
        os.kill(os.getpid(), signal.SIGHUP)

for _ in range(2):
    threading.Thread(target=storm, daemon=True).start()
count = 0
while time.monotonic() < over:
    event.set()
    event.wait(0.01)
    event.clear()
    count += 1
print(count > 0)
"""


def test_it_wakes_a_waiting_call_until_it_is_cleared() -> None:
    event = Wakeup()
    assert not event.wait(0.0)
    event.set()
    event.set()
    assert event.is_set()
    assert event.wait(0.0)
    event.clear()
    assert not event.is_set()
    assert not event.wait(0.0)
    threading.Timer(0.01, event.set).start()
    assert event.wait(30.0)


def test_signals_that_interrupt_each_other_do_not_lock_it() -> None:
    done = subprocess.run(
        [sys.executable, "-c", STORM.format(event="Wakeup")], capture_output=True, text=True, timeout=60, check=True
    )
    assert done.stdout == "True\n"
