"""A training goes on when a machine joins or is lost. Two agents of torchrun stand for two machines."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the extra `training`")

from benchmarks.loss_curve import loss_gap  # noqa: E402  # after the skip
from benchmarks.provenance import ROOT  # noqa: E402
from model_training.training.loop import TrainingConfig, train  # noqa: E402

#: Longest time of one stage on a busy machine, seconds.
PATIENCE_S = 120


@contextmanager
def machine(address: str, port: int, folder: Path, pack: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Start the agent of a machine with one process. Of two machines, that with the smaller address has process 0.

    The machine with the rendezvous starts first. Short times make the test short: a lost machine leaves the rendezvous after 3 s
    instead of 15 s, and it waits 1 s instead of 30 s for further machines.
    """
    command = [
        sys.executable,
        "-m",
        "torch.distributed.run",
        "--nnodes",
        "1:2",
        "--nproc-per-node",
        "1",
        "--max-restarts",
        "2",
    ]
    command += [
        "--rdzv-id",
        "test",
        "--rdzv-backend",
        "c10d",
        "--rdzv-endpoint",
        f"127.0.0.1:{port}",
        "--local-addr",
        address,
    ]
    command += ["--rdzv-conf", "keep_alive_interval=1,keep_alive_max_attempt=3,last_call_timeout=1"]
    command += ["--", str(Path(__file__).with_name("held_training.py")), str(folder), str(pack)]
    surroundings = os.environ | {"OMP_NUM_THREADS": "1", "TORCH_DISABLE_SHARE_RDZV_TCP_STORE": "1"}
    log = folder / f"{address}.log"
    with log.open("wb") as told:
        agent = subprocess.Popen(command, cwd=ROOT, env=surroundings, stdout=told, stderr=told)
    try:
        yield agent
    finally:
        if agent.poll() is None:
            agent.terminate()  # torchrun ends its processes, which have sessions of their own
        agent.wait()


def lose(agent: subprocess.Popen[bytes]) -> None:
    """Kill the agent and its process, as a machine without power would lose them."""
    processes = Path(f"/proc/{agent.pid}/task/{agent.pid}/children").read_text().split()
    assert processes
    for pid in (agent.pid, *map(int, processes)):
        os.kill(pid, signal.SIGKILL)


def wait_until(reached: Callable[[], object], what: str, *agents: subprocess.Popen[bytes]) -> None:
    limit = time.monotonic() + PATIENCE_S
    while not reached():
        assert all(agent.poll() is None for agent in agents), (
            f"an agent ended before: {what}"
        )  # its log is beside the run
        assert time.monotonic() < limit, f"not in time: {what}"
        time.sleep(0.05)


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


@pytest.fixture
def config(shape):
    """Hard negatives begin at step 4. The rate is low, because rounding errors grow at a higher one."""
    return TrainingConfig(
        steps=16,
        pairs=24,
        learning_rate=1e-4,
        warm_up_steps=2,
        encoder=shape,
        memory_after=4,
        alike_seeds=3,
        alike_each=3,
        shards=2,
    )


def test_a_training_goes_on_when_a_machine_joins_and_when_it_is_lost(pack_folder, tmp_path, config):
    """One process trains 5 steps, two train steps 6 to 10 and then lose the first of them, and one trains on from step 9.

    The machine that joins gets process 0, which writes the checkpoints and has the key store. So the loss of this machine is the
    hardest one that a training can survive.
    """
    (tmp_path / "config.json").write_text(config.model_dump_json())
    holds = [tmp_path / "hold-1-5", tmp_path / "hold-2-10"]
    for hold in holds:
        hold.touch()

    def steps() -> list[tuple[int, int, float]]:
        file = tmp_path / "steps.jsonl"
        return [tuple(json.loads(line)) for line in file.read_text().splitlines()] if file.exists() else []

    port = free_port()
    with machine("127.0.0.2", port, tmp_path, pack_folder) as first:
        wait_until(lambda: (1, 5) in [step[:2] for step in steps()], "one process trains", first)
        with machine("127.0.0.1", port, tmp_path, pack_folder) as second:
            log = tmp_path / "127.0.0.2.log"
            wait_until(
                lambda: re.search("closing signal SIGTERM", log.read_text()),
                "the agent sees the new machine",
                first,
                second,
            )
            holds[0].unlink()
            wait_until(lambda: (2, 10) in [step[:2] for step in steps()], "two processes train", first, second)
            lose(second)
        first.wait(PATIENCE_S)
        assert first.returncode == 0, log.read_text()

    # SIGTERM saved step 5, so nothing was repeated. The killed process saved step 9 before it stopped in step 10.
    assert [step[:2] for step in steps()] == [
        *((1, step) for step in range(1, 6)),
        *((2, step) for step in range(6, 11)),
        *((1, step) for step in range(10, 17)),
    ]
    alone = []
    train([pack_folder], tmp_path / "alone", config, device="cpu", report=lambda progress: alone.append(progress.loss))
    last = {step: loss for _, step, loss in steps()}
    assert loss_gap(np.array(alone), np.array([last[step] for step in range(1, 17)])) < 1e-3
