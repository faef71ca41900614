"""A Ray cluster of two nodes, and its running tasks. Needs the extra ``ray``."""

import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

#: Ray names the process of a running task so.
TASK = "ray::_in_task"


def running_tasks() -> list[int]:
    """Return the process ids of the tasks that run now."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            if (folder / "cmdline").read_bytes().startswith(TASK.encode()):
                found.append(int(folder.name))
        except OSError:  # the process has ended
            continue
    return found


def until(is_true: Callable[[], Any], seconds: float = 120.0) -> Any:
    """Wait until a function returns something true, and return it."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if found := is_true():
            return found
        time.sleep(0.02)
    raise AssertionError("it did not happen in time")


def require_survival(cluster: Any, process: subprocess.Popen[str]) -> None:
    """Kill a worker and lose a node while a command runs. Require that the command reports the worker and succeeds.

    Args:
        cluster: of ``ray_cluster``.
        process: the command; its stderr is a pipe.
    """
    killed = until(running_tasks)[0]
    os.kill(killed, signal.SIGKILL)
    until(lambda: [pid for pid in running_tasks() if pid != killed])
    cluster.remove_node(cluster.nodes[0], allow_graceful=False)
    _, said = process.communicate(timeout=300)
    assert process.returncode == 0, said
    assert "WorkerCrashedError" in said


@pytest.fixture
def ray_cluster(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """A head without cores, and two nodes with one core each. Each has processes of its own."""
    from ray.cluster_utils import Cluster

    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    monkeypatch.setenv("RAY_worker_niceness", "0")  # by default, other programs of a busy machine go first
    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
    try:
        made.nodes = [made.add_node(num_cpus=1) for _ in range(2)]
        yield made
    finally:
        made.shutdown()
