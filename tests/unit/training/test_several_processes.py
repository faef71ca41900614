"""Processes that torchrun starts learn what one process learns."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the extra `training`")

from torch._C._distributed_c10d import HashStore  # noqa: E402  # after the skip

from benchmarks.loss_curve import loss_gap  # noqa: E402
from benchmarks.provenance import ROOT  # noqa: E402
from model_training.training import processes  # noqa: E402
from model_training.training.augment import Augmenter  # noqa: E402
from model_training.training.batches import City  # noqa: E402
from model_training.training.loop import (  # noqa: E402
    TrainingConfig,
    _own_views,
    load_run,
    require_shards,
    shard_bounds,
    train,
)
from model_training.training.packs import Pack  # noqa: E402
from model_training.training.processes import Processes, name_of_start, require_devices  # noqa: E402
from service.errors import DatasetError  # noqa: E402
from service.imaging.view_grid import ViewGrid  # noqa: E402

#: Longest time of a start with its training on a busy machine, seconds.
PATIENCE_S = 120


@pytest.fixture(scope="module")
def config(shape):
    """Two processes share three shards, so their parts of a batch differ in size. Hard negatives begin at step 4.

    At a higher rate, rounding errors grow quickly: after 30 steps at a rate of 0.01 the curves differ by some percent.
    """
    return TrainingConfig(
        steps=14,
        pairs=24,
        learning_rate=1e-3,
        warm_up_steps=2,
        encoder=shape,
        memory_after=4,
        alike_seeds=3,
        alike_each=3,
        shards=3,
    )


@contextmanager
def two_processes(
    pack: Path, folder: Path, config: TrainingConfig, *options: str, restarts: int = 0
) -> Iterator[subprocess.Popen[str]]:
    folder.mkdir()
    (folder / "config.json").write_text(config.model_dump_json())
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    command += ["--max-restarts", str(restarts), "--monitor-interval", "0.1", "-m", "--", "benchmarks.loss_curve"]
    command += ["--run", str(folder / "run"), "--packs", str(pack), "--config", str(folder / "config.json")]
    command += ["--out", str(folder / "losses.json"), *options]
    surroundings = os.environ | {"OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(command, cwd=ROOT, env=surroundings, stderr=subprocess.PIPE, text=True)
    try:
        yield process
    finally:
        if process.poll() is None:
            process.terminate()  # torchrun ends its processes, which have sessions of their own
        process.communicate()


def end(process: subprocess.Popen[str]) -> None:
    told = process.communicate(timeout=PATIENCE_S)[1]
    assert process.returncode == 0, told


def workers_of(process: subprocess.Popen[str]) -> list[int]:
    return [int(pid) for pid in Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()]


def wait_for(path: Path, process: subprocess.Popen[str]) -> None:
    limit = time.monotonic() + PATIENCE_S
    while not path.exists():
        assert process.poll() is None, f"ended without {path.name}"
        assert time.monotonic() < limit, f"no {path.name}"
        time.sleep(0.02)


def curve_of_one(pack: Path, folder: Path, config: TrainingConfig):
    losses = []
    net = train([pack], folder, config, device="cpu", report=lambda progress: losses.append(progress.loss))
    return net, np.array(losses)


def test_two_processes_learn_the_same_as_one_and_only_the_first_writes(pack_folder, tmp_path, config):
    folder = tmp_path / "two"
    with two_processes(pack_folder, folder, config) as process:
        end(process)
    alone, losses = curve_of_one(pack_folder, tmp_path / "one", config)
    both = np.array(json.loads((folder / "losses.json").read_text()))
    assert len(both) == config.steps
    assert loss_gap(losses, both) < 1e-4
    for name, weights in load_run(folder / "run").state_dict().items():
        torch.testing.assert_close(weights, alone.state_dict()[name], rtol=0.02, atol=2e-3, msg=name)
    files = [path.name for path in (folder / "run").iterdir()]
    assert sorted(files) == ["checkpoint.pt", "config.json", "packs.json", "tensorboard"]
    assert len(list((folder / "run" / "tensorboard").iterdir())) == 1


def test_two_processes_learn_the_same_as_one_in_mixed_precision(pack_folder, tmp_path, config):
    """A forward pass in bfloat16 rounds to 8 bits. That changes the loss, for one process and for two alike.

    The rate is low, because AdamW turns a rounding error of a small gradient into a whole step. There are no hard negatives, because
    rounding could change their order.
    """
    changes = {"precision": "bfloat16", "steps": 5, "learning_rate": 1e-5, "memory_after": None}
    mixed = config.model_copy(update=changes)
    folder = tmp_path / "two"
    with two_processes(pack_folder, folder, mixed) as process:
        end(process)
    losses = curve_of_one(pack_folder, tmp_path / "one", mixed)[1]
    both = np.array(json.loads((folder / "losses.json").read_text()))
    assert len(both) == mixed.steps
    assert loss_gap(losses, both) < 5e-3
    full = curve_of_one(pack_folder, tmp_path / "full", mixed.model_copy(update={"precision": "float32", "steps": 1}))[
        1
    ]
    assert loss_gap(full, both[:1]) > 1e-5  # in float32, the first losses of one process and of two differ by 0.000001
    kept = load_run(folder / "run").state_dict()
    assert {weights.dtype for weights in kept.values() if weights.is_floating_point()} == {torch.float32}


def test_a_run_resumes_after_a_process_was_killed(pack_folder, tmp_path, config):
    longer = config.model_copy(update={"steps": 100, "learning_rate": 1e-4})
    folder = tmp_path / "killed"
    with two_processes(pack_folder, folder, longer, "--save-every", "3", restarts=1) as process:
        wait_for(folder / "run" / "checkpoint.pt", process)
        os.kill(workers_of(process)[-1], signal.SIGKILL)
        end(process)
    after = np.array(json.loads((folder / "losses.json").read_text()))
    assert 0 < len(after) <= longer.steps - 3  # the processes of the restart began at a checkpoint
    losses = curve_of_one(pack_folder, tmp_path / "one", longer)[1]
    first = len(losses) - len(after)
    assert loss_gap(losses[first : first + 5], after[:5]) < 1e-3  # later, rounding changes which negatives are hard


def test_a_restart_uses_a_new_name_although_the_store_keeps_the_old_one():
    store = HashStore()
    names = []
    for _ in range(3):
        with ThreadPoolExecutor(3) as pool:
            found = set(pool.map(lambda rank: name_of_start(store, rank, 3, limit_s=20), range(3)))
        assert len(found) == 1
        names += found
    assert len(set(names)) == 3


def test_a_process_that_does_not_start_is_named():
    with pytest.raises(DatasetError, match=r"processes \[1\] of 2 did not start within 0 s"):
        name_of_start(HashStore(), 0, 2, limit_s=0.1)


def test_a_process_that_has_lost_another_one_says_why_and_ends_its_simulations(monkeypatch, capsys):
    ended = []
    simulating = SimpleNamespace(terminate=lambda: ended.append("simulating"))
    monkeypatch.setattr("multiprocessing.active_children", lambda: [simulating])
    monkeypatch.setattr("os._exit", ended.append)
    processes._end("another training process has failed")
    assert ended == ["simulating", 1]
    assert capsys.readouterr().err.startswith(
        "streetfix: another training process has failed; this process ends, and torchrun"
    )


@pytest.mark.parametrize(("pairs", "shards"), [(24, 2), (23, 3), (7, 3)])
def test_shards_cover_a_batch_and_processes_cover_the_shards(pairs, shards):
    bounds = shard_bounds(pairs, shards)
    sizes = np.diff(bounds)
    assert (bounds[0], bounds[-1]) == (0, pairs)
    assert sizes.max() - sizes.min() <= 1
    for count in range(1, shards + 1):
        shares = Processes(count=count).shares(shards)
        assert [shard for share in shares for shard in share] == list(range(shards))
        assert all(shares)


def test_any_number_of_processes_gives_a_pair_the_same_errors(pack_folder, config):
    grid = ViewGrid(rows=config.encoder.rows, columns=config.encoder.columns)
    city = City(Pack.open(pack_folder), grid, turn_deg=config.turn_deg)
    choice = city.choose(23, np.random.default_rng(0))
    bounds = shard_bounds(len(choice), config.shards)

    def halves(count: int):
        planes = []
        for rank in range(count):
            augment = Augmenter(config.augmentation, grid, torch.Generator(), torch.device("cpu"))
            mine = _own_views(city, choice, bounds, Processes(rank, count), augment, config, step=5)
            planes.append(mine.reshape(2, -1, *mine.shape[1:]))
        return torch.cat(planes, dim=1)

    alone = halves(1)
    assert alone.shape[:2] == (2, 23)
    for count in (2, 3):
        torch.testing.assert_close(halves(count), alone, rtol=0, atol=0)


def test_more_processes_than_shards_are_refused(config):
    require_shards(config, 3)
    with pytest.raises(DatasetError, match="4 processes share each batch, but the run has --shards 3"):
        require_shards(config, 4)


def test_shards_that_could_be_empty_are_refused(config):
    with pytest.raises(DatasetError, match="24 pairs has at most 12 shards, not 13"):
        require_shards(config.model_copy(update={"shards": 13}), 1)


def test_processes_without_a_gpu_of_their_own_are_refused():
    require_devices([("cuda", 2, 2, "a"), ("cuda", 2, 2, "a")])
    require_devices([("cpu", 0, 2, "a"), ("cpu", 1, 2, "b")])
    with pytest.raises(DatasetError, match=r"b has 1 GPUs for 2 processes.*--nproc-per-node 1"):
        require_devices([("cuda", 2, 2, "a"), ("cuda", 1, 2, "b")])
    with pytest.raises(DatasetError, match="a trains on cuda and b on cpu"):
        require_devices([("cuda", 1, 1, "a"), ("cpu", 0, 1, "b")])
