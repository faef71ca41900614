"""Training processes that torchrun starts, on one or several machines.

Every process holds the whole network and the whole descriptor memory, and it reads only its own part of a batch.
Control data goes over gloo. Tensors of a GPU go over NCCL.
"""

import multiprocessing
import os
import secrets
import socket
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.distributed as dist
from numpy.typing import NDArray
from torch import Tensor
from torch.distributed import PrefixStore, Store, TCPStore  # type: ignore[attr-defined]  # torch documents them

from model_training.training.watch import Watch, connect
from service.errors import DatasetError, StreetfixError

#: Longest time from the start of a process to that of the last one, seconds. Packages on a network drive load slowly.
START_WITHIN_S = 300.0


@dataclass(frozen=True)
class Processes:
    """The processes that train one encoder together, as one of them sees them.

    The default is a process that trains alone.

    Attributes:
        rank: number of this process, 0 to ``count`` - 1. Process 0 writes all files.
        count: number of processes.
        local_rank: number of this process among those of its machine.
        local_count: number of processes of this machine.
        tensors: group for tensors of the training device; None if the process trains alone.
    """

    rank: int = 0
    count: int = 1
    local_rank: int = 0
    local_count: int = 1
    tensors: dist.ProcessGroup | None = None

    @property
    def is_first(self) -> bool:
        """Whether this process writes checkpoint, log and progress."""
        return self.rank == 0

    def device(self, place: torch.device) -> torch.device:
        """Return the device of this process: the processes of a machine use different GPUs.

        Args:
            place: device of the command.
        """
        return torch.device("cuda", self.local_rank) if place.type == "cuda" and self.count > 1 else place

    def shares(self, total: int) -> list[range]:
        """Return which of ``total`` parts each process handles.

        Args:
            total: number of parts.
        """
        return [range(k * total // self.count, (k + 1) * total // self.count) for k in range(self.count)]

    def any(self, flag: bool) -> bool:
        """Return whether the flag is set in any process. All processes must call it.

        Args:
            flag: flag of this process.
        """
        if self.count == 1:
            return flag
        flags = torch.tensor([int(flag)])
        dist.all_reduce(flags, dist.ReduceOp.MAX)
        return bool(flags.item())

    def of_first(self, numbers: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the numbers of the first process, so that rounding cannot make the processes choose different pairs.

        Args:
            numbers: numbers of this process (N,); N may differ.
        """
        if self.count == 1:
            return numbers
        size = torch.tensor([len(numbers)])
        dist.broadcast(size, 0)
        shared = torch.from_numpy(numbers.copy()) if self.is_first else torch.empty(int(size), dtype=torch.int64)
        dist.broadcast(shared, 0)
        return shared.numpy()

    def gather(self, queries: Tensor, surveys: Tensor, *, sizes: Sequence[int]) -> tuple[Tensor, Tensor]:
        """Return the descriptors of all processes, in order.

        Each process then computes the same loss of all pairs. The gradient of its own descriptors is multiplied by the
        number of processes, because ``DistributedDataParallel`` takes the mean over the processes where a sum is needed.

        Args:
            queries: query descriptors of this process (N, D).
            surveys: descriptors of the survey views of this process (N, D).
            sizes: number of pairs of each process; their sum is B.

        Returns:
            Query descriptors (B, D), and descriptors of the survey views (B, D).
        """
        if self.count == 1:
            return queries, surveys
        both: Tensor = _Gather.apply(  # type: ignore[no-untyped-call]  # torch leaves it untyped
            torch.cat([queries, surveys], dim=1), tuple(sizes), self.rank, self.tensors
        )
        length = queries.shape[1]
        return both[:, :length].contiguous(), both[:, length:].contiguous()

    def average_gradient(self, parameter: torch.nn.Parameter) -> None:
        """Replace the gradient of a parameter outside the network by the mean over the processes.

        Args:
            parameter: parameter with a gradient.
        """
        if self.count > 1 and parameter.grad is not None:
            dist.all_reduce(parameter.grad, group=self.tensors)
            parameter.grad /= self.count

    def in_turn(self, action: Callable[[], None]) -> None:
        """Run an action in the first process and then in the others. All raise the error of the first.

        Args:
            action: writes a file that does not exist, or checks a file that does.
        """
        if self.count == 1:
            action()
            return
        error: list[Any] = [None]
        if self.is_first:
            try:
                action()
            except StreetfixError as raised:
                error[0] = raised
        dist.broadcast_object_list(error, 0)
        if error[0] is not None:
            raise error[0]
        if not self.is_first:
            action()

    def wait(self) -> None:
        """Wait until all processes have reached this call."""
        if self.count > 1:
            dist.barrier()

    def require_shared(self, folder: Path, field: str) -> None:
        """Create a folder, and check that all processes see the same one.

        Args:
            folder: the folder.
            field: name of the option that gave it.

        Raises:
            DatasetError: a process does not see what the first process writes.
        """
        folder.mkdir(parents=True, exist_ok=True)
        if self.count == 1:
            return
        name = [f".shared-{secrets.token_hex(8)}"]
        dist.broadcast_object_list(name, 0)
        mark = folder / name[0]
        if self.is_first:
            mark.touch()
        self.wait()
        missing = self.any(not mark.exists())
        if self.is_first:
            mark.unlink()
        if missing:
            raise DatasetError(
                f"{field}: {folder}: the processes see different folders; give a folder that all machines share",
                field=field,
            )


#: A process that trains alone.
ALONE = Processes()


@contextmanager
def joined(place: torch.device) -> Iterator[Processes]:
    """Join the processes that torchrun started. Without torchrun, or with one process, the process trains alone.

    If another process fails or is lost, this one ends with exit code 1 (``watch``). torchrun can then start all processes again.

    Args:
        place: training device of the command.

    Raises:
        DatasetError: the processes have different devices, or a machine has more processes than GPUs.
    """
    count = int(os.environ.get("WORLD_SIZE", "1"))
    if count == 1:
        yield Processes()
        return
    rank, local_rank = int(os.environ["RANK"]), int(os.environ["LOCAL_RANK"])
    local_count = int(os.environ["LOCAL_WORLD_SIZE"])
    store, failed = _store_of_start(rank, count), True
    # First the watch: a process that is lost now would keep the others waiting in ``init_process_group``.
    connections = connect(store, rank, count, os.environ["MASTER_ADDR"], within_s=START_WITHIN_S)
    watch = Watch(connections, _end)
    try:
        dist.init_process_group("gloo", store=store, rank=rank, world_size=count)
        seen: list[Any] = [None] * count
        dist.all_gather_object(seen, (place.type, torch.cuda.device_count(), local_count, socket.gethostname()))
        require_devices(seen)
        tensors = dist.group.WORLD
        if place.type == "cuda":
            torch.cuda.set_device(local_rank)
            tensors = dist.new_group(backend="nccl")
        yield Processes(rank, count, local_rank, local_count, tensors)
        failed = False
    finally:
        watch.leave(failed=failed)
        if dist.is_initialized():
            dist.destroy_process_group()


def _store_of_start(rank: int, count: int) -> Store:
    """Return the key store of the processes, without keys of an earlier start.

    Args:
        rank: number of this process.
        count: number of processes.
    """
    host, port = os.environ["MASTER_ADDR"], int(os.environ["MASTER_PORT"])
    if os.environ.get("TORCHELASTIC_USE_AGENT_STORE") == "True":
        agent = TCPStore(host, port, is_master=False)
        return PrefixStore(name_of_start(agent, rank, count), agent)
    return TCPStore(host, port, count, rank == 0, timedelta(seconds=START_WITHIN_S))


def _end(reason: str) -> None:
    """End this process, because it cannot go on without another one. Its main thread may wait in gloo, NCCL or for a file.

    Args:
        reason: what happened to the other process.
    """
    sys.stderr.write(
        f"streetfix: {reason}; this process ends, and torchrun starts the processes again if --max-restarts allows it\n"
    )
    sys.stderr.flush()
    for simulating in multiprocessing.active_children():
        simulating.terminate()
    os._exit(1)


def name_of_start(agent: Store, rank: int, count: int, *, limit_s: float = START_WITHIN_S) -> str:
    """Agree on a name that no earlier start of the same processes used.

    torchrun keeps one store for all its restarts. There, a process would find the addresses of processes that have ended,
    and wait for them (https://github.com/pytorch/pytorch/issues/135712). The number of restarts is no such name, because
    the machines count separately.

    Args:
        agent: store of torchrun.
        rank: number of this process.
        count: number of processes.
        limit_s: longest time to wait for the other processes, seconds.

    Raises:
        DatasetError: a process did not start in time.
    """
    own, store = secrets.token_hex(8), PrefixStore("streetfix", agent)
    if rank > 0:
        store.set(f"asks/{rank}", own)
        store.wait([f"reply/{own}"], timedelta(seconds=limit_s))
        name = store.get(f"reply/{own}").decode()
        store.set(f"knows/{name}/{rank}", "1")
        return name
    missing, limit = set(range(1, count)), time.monotonic() + limit_s
    answered: dict[int, str] = {}
    while missing:
        for other in tuple(missing):
            asks = store.get(f"asks/{other}").decode() if store.check([f"asks/{other}"]) else None
            if asks is not None and answered.get(other) != asks:  # at first, perhaps a process that has ended
                store.set(f"reply/{asks}", own)
                answered[other] = asks
            if store.check([f"knows/{own}/{other}"]):
                missing.discard(other)
        if time.monotonic() > limit:
            raise DatasetError(
                f"processes {sorted(missing)} of {count} did not start within {limit_s:.0f} s; read their messages, or "
                "start again",
                field="run",
            )
        time.sleep(0.02)
    return own


def require_devices(seen: Sequence[tuple[str, int, int, str]]) -> None:
    """Check the devices of all processes.

    Args:
        seen: type of the training device, GPUs of the machine, processes of the machine, and its name; of each process.

    Raises:
        DatasetError: the processes have different devices, or a machine has more processes than GPUs.
    """
    types = {kind: host for kind, _, _, host in seen}
    if len(types) > 1:
        raise DatasetError(
            f"device: {types['cuda']} trains on cuda and {types['cpu']} on cpu; give all processes the same --device",
            field="device",
        )
    for kind, gpus, processes, host in seen:
        if kind == "cuda" and processes > gpus:
            raise DatasetError(
                f"device: {host} has {gpus} GPUs for {processes} processes; start torchrun with --nproc-per-node {gpus}, "
                "or use --device cpu",
                field="device",
            )


class _Gather(torch.autograd.Function):
    """Gather rows of all processes; see ``Processes.gather``."""

    @staticmethod
    def forward(ctx: Any, rows: Tensor, sizes: tuple[int, ...], rank: int, group: dist.ProcessGroup) -> Tensor:
        first = sum(sizes[:rank])
        ctx.own, ctx.count = slice(first, first + sizes[rank]), len(sizes)
        padded = rows.new_zeros(max(sizes), rows.shape[1])
        padded[: len(rows)] = rows
        parts = [torch.empty_like(padded) for _ in sizes]
        dist.all_gather(parts, padded, group=group)
        return torch.cat([part[:size] for part, size in zip(parts, sizes, strict=True)])

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None, None]:
        return gradients[0][ctx.own] * ctx.count, None, None, None
