"""Engines that cannot run are refused, and what Ray is asked for."""

import sys

import pytest

from model_training.tasks.engines import require_engine
from model_training.tasks.ray_cluster import _largest_memory
from service.errors import DatasetError, ExtraMissingError


def test_the_default_engine_needs_nothing():
    require_engine("local", None)
    require_engine("local", 3)


def test_engines_that_cannot_run_are_refused(monkeypatch):
    with pytest.raises(DatasetError, match="engine: 'slurm' is unknown; give local or ray"):
        require_engine("slurm", None)
    with pytest.raises(DatasetError, match="workers: 0 is not valid; give 1 or more"):
        require_engine("local", 0)
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ExtraMissingError, match=r"--engine ray needs the package 'ray': .*\[ray\]"):
        require_engine("ray", None)


def test_a_task_asks_for_no_more_memory_than_a_machine_with_cores_has():
    def node(memory, cores, *, alive=True):
        return {"Alive": alive, "Resources": {"memory": memory} | ({"CPU": cores} if cores else {})}

    nodes = [node(64.0, 0), node(32.0, 8, alive=False), node(8.0, 2), node(16.0, 4)]
    assert _largest_memory(nodes) == 16.0
    assert _largest_memory(nodes[:2]) == 0.0  # the cluster may start a machine later
