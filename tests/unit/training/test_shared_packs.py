import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

torch = pytest.importorskip("torch", reason="needs the extra `training`")

import torch.distributed as dist  # noqa: E402  # after the skip

from model_training.training import shared_packs  # noqa: E402
from model_training.training.packs import PackPlan  # noqa: E402
from model_training.training.processes import Processes  # noqa: E402
from model_training.training.shared_packs import make_packs_together  # noqa: E402
from service.errors import DatasetError  # noqa: E402
from service.imaging.view_grid import ViewGrid  # noqa: E402


class Threads(Processes):
    """Two threads in place of two processes."""

    barrier = threading.Barrier(2)

    def wait(self):
        self.barrier.wait(timeout=60)

    def require_shared(self, folder, field):  # noqa: ARG002  # the name is part of the interface
        folder.mkdir(exist_ok=True)


def test_the_processes_share_the_missing_packs_and_wait_for_all(tmp_path, monkeypatch):
    plans = [PackPlan(seed=seed) for seed in range(5)]
    (tmp_path / plans[0].stem).mkdir()
    made = []

    def make(own, root, grid, *, workers, report):
        made.append([plan.seed for plan in own])
        for plan in own:
            (root / plan.stem).mkdir()

    monkeypatch.setattr(shared_packs, "make_packs", make)
    monkeypatch.setattr(shared_packs, "LOOK_EVERY_S", 0.01)
    with ThreadPoolExecutor(2) as pool:
        folders = list(
            pool.map(lambda rank: make_packs_together(plans, tmp_path, ViewGrid(), Threads(rank, 2)), range(2))
        )
    assert sorted(made) == [[1, 3], [2, 4]]
    assert folders == [[tmp_path / plan.stem for plan in plans]] * 2


def test_processes_that_see_different_folders_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(dist, "broadcast_object_list", lambda *_: None)
    monkeypatch.setattr(dist, "barrier", lambda: None)
    monkeypatch.setattr(dist, "all_reduce", lambda *_: None)
    Processes(0, 2).require_shared(tmp_path, "run")
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(DatasetError, match=r"run: .*the processes see different folders"):
        Processes(1, 2).require_shared(tmp_path, "run")  # the first process wrote its mark elsewhere


def test_an_error_of_the_first_process_reaches_the_others(monkeypatch):
    sent, done = [], []

    def broadcast(what, _):
        if sent:
            what[:] = sent
        else:
            sent.extend(what)

    def refuse():
        done.append(1)
        raise DatasetError("another configuration", field="run")

    monkeypatch.setattr(dist, "broadcast_object_list", broadcast)
    for rank in range(2):
        with pytest.raises(DatasetError, match="another configuration"):
            Processes(rank, 2).in_turn(refuse)
    assert done == [1]
