"""A Ray cluster of two nodes, and its running tasks. Needs the extra ``ray``."""

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
