"""Run the tiles of a map: in processes of this machine (``local``), or as tasks of Ray (``ray``).

Both engines call ``build_tile`` and nothing else, and a tile's folder is its only result. So both give the same bytes. A process that
dies loses no finished tile and no finished part of its own tile.
"""

import multiprocessing
import os
import signal
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, Literal, get_args

from model_training.mapping.build_tile import THREADS, TileTask, build_tile
from service import errors
from service.errors import BundleError, DatasetError, StreetfixError, extra_missing
from service.heap import limit_heap

Engine = Literal["local", "ray"]
ENGINES: tuple[Engine, ...] = get_args(Engine)
#: Memory of a process that builds a tile: a part for the programs, and a part for each scan, bytes (decision 0166).
PROCESS_BYTES, SCAN_BYTES = 300 << 20, 320 << 10
#: Arrays of this size or more go back to the system as soon as they are free: scans are smaller, sums of voxels are larger.
_MAPPED_BYTES = 2 << 20
#: How often a tile is started before the build gives up, if the process that builds it dies: on this machine, and with Ray, whose
#: machines may be taken away.
LOCAL_ATTEMPTS, RAY_ATTEMPTS = 2, 4
#: Time between two reports of a tile's progress, seconds.
_EVERY_S = 0.5

#: Progress callback: index of a task, and its finished share, 0 to 1.
OnProgress = Callable[[int, float], None]
#: Error of a task that can be sent to another process: class, message, field. A class that is no error of Streetfix has a traceback as its
#: message.
Failure = tuple[str, str, str]


def require_engine(engine: str, workers: int | None) -> None:
    """Refuse an engine that cannot run, before the work.

    Args:
        engine: name of the engine.
        workers: number of processes; None for the default.

    Raises:
        DatasetError: there is no such engine, or the number is below 1.
        ExtraMissingError: Ray is not installed.
    """
    if engine not in ENGINES:
        raise DatasetError(f"engine: {engine!r} is unknown; give {' or '.join(ENGINES)}", field="engine")
    if workers is not None and workers < 1:
        raise DatasetError(f"workers: {workers} is not valid; give 1 or more", field="workers")
    if engine == "ray":
        try:
            import ray  # noqa: F401
        except ModuleNotFoundError as error:
            raise extra_missing("--engine ray", "ray", error) from error


def memory_of(task: TileTask) -> int:
    """Return the memory that a process needs for a tile, bytes: an upper estimate.

    Args:
        task: the tile.
    """
    return PROCESS_BYTES + SCAN_BYTES * len(task.numbers)


def usual_workers(tasks: Sequence[TileTask]) -> int:
    """Return the default number of processes: one per core, fewer if the largest tiles do not fit into memory side by side.

    Args:
        tasks: the tiles, at least one.
    """
    largest = max(memory_of(task) for task in tasks)
    return max(1, min(_cores(), len(tasks), _free_bytes() // largest))


def run(
    engine: Engine,
    tasks: Sequence[TileTask],
    *,
    workers: int | None,
    on_progress: OnProgress,
    warn: Callable[[str], None],
) -> None:
    """Build all tiles.

    Args:
        engine: ``local`` or ``ray``.
        tasks: the tiles.
        workers: number of processes; None takes ``usual_workers``, and on a cluster of Ray all of its cores.
        on_progress: called with the progress of each tile.
        warn: called with a line of text if a process dies.

    Raises:
        StreetfixError: a tile cannot be built.
        BundleError: the process of a tile died in every attempt.
    """
    if not tasks:
        return
    # The longest tile first, so that none of them runs alone at the end.
    order = sorted(range(len(tasks)), key=lambda index: -len(tasks[index].numbers))
    if engine == "local":
        _run_local(tasks, order, workers or usual_workers(tasks), on_progress, warn)
    else:
        _run_ray(tasks, order, workers, on_progress, warn)


def attempt(task: TileTask, on_progress: Callable[[float], None]) -> Failure | None:
    """Build a tile; return the error if it cannot be built.

    Args:
        task: the tile.
        on_progress: called with the finished share, at most twice per second.
    """
    last_s = -_EVERY_S

    def share(finished: float) -> None:
        nonlocal last_s
        if time.monotonic() - last_s >= _EVERY_S:
            last_s = time.monotonic()
            on_progress(finished)

    limit_heap(THREADS, mapped_bytes=_MAPPED_BYTES)
    try:
        build_tile(task, share)
    except StreetfixError as error:
        return type(error).__name__, error.message, error.field
    except Exception as error:  # the other process raises it again
        return type(error).__name__, traceback.format_exc(), ""
    return None


def _raise(task: TileTask, failure: Failure) -> None:
    name, message, field = failure
    kind = getattr(errors, name, None)
    if isinstance(kind, type) and issubclass(kind, StreetfixError):
        raise kind(message, field=field)
    if name == "MemoryError":
        raise BundleError(f"{task.name}: the memory is full; {_LESS_MEMORY}", field="workers")
    raise RuntimeError(f"{task.name} failed:\n{message}")


_LESS_MEMORY = (
    "give fewer --workers or a smaller --tile-m, and run the command again: it goes on with the unfinished tiles"
)


def _died(task: TileTask, how: str, attempts: int, most: int, warn: Callable[[str], None]) -> None:
    """Report a process that died; raise if the tile has no attempt left."""
    if attempts >= most:
        raise BundleError(f"{task.name}: its process {how} in each of {most} attempts; {_LESS_MEMORY}", field="workers")
    warn(f"{task.name}: its process {how}; the tile goes on in another process")


# -- processes of this machine ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _Running:
    """A process that builds a tile."""

    index: int
    attempts: int
    process: BaseProcess
    pipe: Connection


def _run_local(
    tasks: Sequence[TileTask], order: Sequence[int], workers: int, on_progress: OnProgress, warn: Callable[[str], None]
) -> None:
    """Build each tile in a process of its own, so that its memory is free afterwards."""
    waiting = deque((index, 1) for index in order)
    running: list[_Running] = []
    try:
        while waiting or running:
            while waiting and len(running) < workers:
                running.append(_started(tasks, *waiting.popleft()))
            wait([each.pipe for each in running])
            for each in list(running):
                failure: Failure | Literal["died"] | None = None
                try:
                    if not each.pipe.poll():
                        continue
                    message = each.pipe.recv()
                except EOFError:
                    failure = "died"
                else:
                    if isinstance(message, float):
                        on_progress(each.index, message)
                        continue
                    failure = message[0]
                each.process.join()
                each.pipe.close()
                running.remove(each)
                if failure == "died":
                    how = _how(each.process.exitcode)
                    _died(tasks[each.index], how, each.attempts, LOCAL_ATTEMPTS, warn)
                    waiting.appendleft((each.index, each.attempts + 1))
                elif failure is not None:
                    _raise(tasks[each.index], failure)
                else:
                    on_progress(each.index, 1.0)
    finally:
        for each in running:
            each.process.kill()  # a part is complete or absent, so nothing is left half
        for each in running:
            each.process.join()
            each.pipe.close()


def _started(tasks: Sequence[TileTask], index: int, attempts: int) -> _Running:
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_in_process, args=(sender, tasks[index]), name=tasks[index].name, daemon=True)
    process.start()
    sender.close()  # so that the end of the process closes the pipe
    return _Running(index, attempts, process, receiver)


def _in_process(pipe: Connection, task: TileTask) -> None:
    """Build a tile and send shares, and at last a tuple of the failure or None."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the parent, which ends its processes
    threading.Thread(target=_end_with_parent, daemon=True).start()
    with suppress(BrokenPipeError):  # the parent has died, and this process ends too
        pipe.send((attempt(task, pipe.send),))


def _end_with_parent() -> None:
    """End this process when its parent has died, so that the next build finds no process at work."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


def _how(exitcode: int | None) -> str:
    if exitcode is not None and exitcode < 0:
        name = signal.Signals(-exitcode).name
        return f"was killed by {name}" + (" (is the memory full?)" if name == "SIGKILL" else "")
    return f"ended with code {exitcode}"


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _free_bytes(meminfo: Path = Path("/proc/meminfo"), group: Path = Path("/sys/fs/cgroup")) -> int:
    """Return the memory that is free for new processes, bytes: of the machine, or of the control group (version 2) if it has less."""
    found = [os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")]
    with suppress(OSError):  # another system than Linux
        lines = meminfo.read_text().splitlines()
        found += [int(line.split()[1]) << 10 for line in lines if line.startswith("MemAvailable:")]
    with suppress(OSError, ValueError):  # no control group, or one without a limit ("max")
        found.append(int((group / "memory.max").read_text()) - int((group / "memory.current").read_text()))
    return max(0, min(found))


# -- Ray ----------------------------------------------------------------------------------------------------------------------------------


class _Board:
    """Collects the progress of all tiles. It is an actor of Ray."""

    def __init__(self) -> None:
        self._shares: dict[int, float] = {}

    def put(self, index: int, share: float) -> None:
        self._shares[index] = share

    def take(self) -> dict[int, float]:
        found, self._shares = self._shares, {}
        return found


def _in_task(board: Any, index: int, task: TileTask) -> Failure | None:
    return attempt(task, lambda share: board.put.remote(index, share))


def _run_ray(
    tasks: Sequence[TileTask],
    order: Sequence[int],
    workers: int | None,
    on_progress: OnProgress,
    warn: Callable[[str], None],
) -> None:
    """Build each tile as a task of Ray: on the cluster that ``RAY_ADDRESS`` names, else on this machine."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # Ray would send statistics to its vendor
    import ray
    from ray.exceptions import NodeDiedError, OutOfMemoryError, RayActorError, WorkerCrashedError

    own = not ray.is_initialized()
    if own:
        if address := os.environ.get("RAY_ADDRESS"):
            ray.init(address=address, log_to_driver=False)
        else:
            workers = workers or usual_workers(tasks)
            os.environ.setdefault(
                "RAY_worker_niceness", "0"
            )  # Ray's default of 15 would let every other program go first
            ray.init(address="local", num_cpus=workers, include_dashboard=False, log_to_driver=False)
    pending: dict[Any, tuple[int, int]] = {}
    try:
        cluster_cores = int(ray.cluster_resources().get("CPU", 1))
        # A task that asks for more than any machine has would wait for ever.
        largest = int(0.9 * max(node["Resources"].get("memory", 0.0) for node in ray.nodes() if node["Alive"]))
        board = ray.remote(num_cpus=0)(_Board).remote()
        # Ray's own retries would not be reported.
        build = ray.remote(num_cpus=1, max_retries=0)(_in_task)
        waiting = deque((index, 1) for index in order)
        while waiting or pending:
            # More than run at once, so that no core waits for this process.
            while waiting and len(pending) < (workers or 2 * cluster_cores):
                index, attempts = waiting.popleft()
                memory = min(memory_of(tasks[index]), largest)
                pending[build.options(memory=memory).remote(board, index, tasks[index])] = index, attempts
            ready, _ = ray.wait(list(pending), timeout=_EVERY_S)
            with suppress(RayActorError):  # the actor's machine is lost; the tiles still report their end
                for index, share in ray.get(board.take.remote()).items():
                    on_progress(index, share)
            for done in ready:
                index, attempts = pending.pop(done)
                try:
                    failure = ray.get(done)
                except (WorkerCrashedError, NodeDiedError, OutOfMemoryError) as error:
                    how = f"was lost ({type(error).__name__})"
                    _died(tasks[index], how, attempts, RAY_ATTEMPTS, warn)
                    waiting.appendleft((index, attempts + 1))
                    continue
                if failure is not None:
                    _raise(tasks[index], failure)
                on_progress(index, 1.0)
    finally:
        for each in pending:
            ray.cancel(each, force=True)
        if own:
            ray.shutdown()
