"""Freed memory goes back to the system. The test uses its own process, because the settings of malloc are per process."""

import platform
import subprocess
import sys

import pytest

_PROGRAM = """
import re, sys, threading
from pathlib import Path
from service.heap import Trimmer, limit_heap

if sys.argv[1] == "kept little":
    limit_heap(1)

def anonymous_mib():
    return int(re.search(r"^RssAnon:\\s+(\\d+)", Path("/proc/self/status").read_text(), re.MULTILINE)[1]) / 1024

def fill():
    block = bytes(range(256)) * (30 * 4096)
    barrier.wait()
    del block

bytes(bytearray(b"1") * (30 * 2**20))  # glibc learns from the first such block that is freed
before = anonymous_mib()
barrier = threading.Barrier(4)
threads = [threading.Thread(target=fill) for _ in range(4)]
for thread in threads: thread.start()
for thread in threads: thread.join()
print(anonymous_mib() - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="the settings are glibc's")
def test_blocks_of_threads_that_have_ended_are_the_systems_again() -> None:
    left = {}
    for how in ("as it comes", "kept little"):
        done = subprocess.run([sys.executable, "-c", _PROGRAM, how], capture_output=True, text=True, check=True)
        left[how] = float(done.stdout)
    assert left["kept little"] < 20
    assert left["as it comes"] > 80  # else the setting is no longer needed


_BETWEEN = """
import re
from pathlib import Path
from service.heap import trim

def anonymous_mib():
    return int(re.search(r"^RssAnon:\\s+(\\d+)", Path("/proc/self/status").read_text(), re.MULTILINE)[1]) / 1024

blocks = [bytearray(4000) for _ in range(20000)]
kept = blocks[::100]
del blocks
before = anonymous_mib()
trim()
print(before - anonymous_mib())
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="malloc_trim is glibc's")
def test_free_memory_between_used_blocks_is_the_systems_again() -> None:
    """80 MB in small blocks, of which every hundredth stays: most pages are free."""
    done = subprocess.run([sys.executable, "-c", _BETWEEN], capture_output=True, text=True, check=True)
    assert float(done.stdout) > 40
