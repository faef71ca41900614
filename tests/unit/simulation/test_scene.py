import os
import subprocess
import sys

import pytest

#: Builds a scene that is large enough for several threads. Prints the threads before and after, and whether the processors are the same.
_BUILD = """
import os
import numpy as np
from model_training.simulation.meshes import Mesh
from model_training.simulation.scene import Scene

def threads():
    return len(os.listdir("/proc/self/task"))

corners = np.random.default_rng(0).random((60000, 3, 3)).astype(np.float32) * 100
mesh = Mesh(corners, np.zeros((60000, 3), np.float32), np.zeros(60000, np.uint8))
before, allowed = threads(), os.sched_getaffinity(0)
Scene(mesh).distances(np.zeros(3), np.eye(3))
print(threads() - before, os.sched_getaffinity(0) == allowed)
"""


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity") or os.cpu_count() == 1, reason="needs Linux and two cores")
def test_embree_has_no_threads_that_a_fork_could_lose():
    """A worker that is forked while such a thread holds a lock waits for ever. It happened during a calibration."""
    done = subprocess.run([sys.executable, "-c", _BUILD], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["0", "True"]
