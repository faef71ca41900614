import os
import subprocess
import sys
import time

import pytest

from model_training.loadtest.processes import usage
from service.errors import RequestError

BUSY = "import time\nt = time.process_time()\nwhile time.process_time() - t < 0.6: pass\nprint('done', flush=True)\ntime.sleep(60)"


def test_a_child_counts_with_its_parent():
    parent = f"import subprocess, sys\nsubprocess.run([sys.executable, '-c', {BUSY!r}])"
    process = subprocess.Popen([sys.executable, "-c", parent], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        assert process.stdout.readline() == "done\n"
        found = usage(process.pid)
        assert 0.55 < found.cpu_s < 5
        assert found.resident_mib > 8  # two interpreters
        assert usage(os.getpid()).cpu_s > found.cpu_s - 5  # this process is the parent of both
        assert usage(os.getpid()).resident_mib > found.resident_mib
    finally:
        subprocess.run(["pkill", "-P", str(process.pid)], check=False)
        process.kill()
        process.wait()
        process.stdout.close()


def test_a_process_that_is_not_there_is_named():
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    time.sleep(0.01)
    with pytest.raises(RequestError, match=f"--pid {process.pid}"):
        usage(process.pid)
