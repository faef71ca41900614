"""Make city archives in processes of this machine (``local``), or as tasks of Ray (``ray``).

Both engines call ``make_archive`` and nothing else, so both give the same bytes. A process that dies loses its own unfinished city and no
other.
"""

import multiprocessing
import os
import secrets
import signal
import threading
import traceback
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any, Literal, get_args

from model_training.training.archive_places import ArchivePlace
from model_training.training.city_archive import archive_name
from model_training.training.city_task import CityTask, code_of_cities, make_archive
from model_training.training.packs import PackPlan
from service import errors
from service.errors import DatasetError, StreetfixError, extra_missing
from service.imaging.view_grid import ViewGrid

Engine = Literal["local", "ray"]
ENGINES: tuple[Engine, ...] = get_args(Engine)
#: How often a city is started before the command gives up, if the process that simulates it dies: on this machine, and with Ray, whose
#: machines may be taken away.
LOCAL_ATTEMPTS, RAY_ATTEMPTS = 2, 4
#: Longest wait for the tasks of Ray without a look at Ctrl-C, seconds.
_LOOK_EVERY_S = 1.0

#: Progress callback: stage, number done, number of all.
Report = Callable[[str, int, int], None]
#: Error of a task that can be sent to another process: class, message, field. A class that is no error of Streetfix has a traceback as its
#: message.
Failure = tuple[str, str, str]

_GOES_ON = "run the command again: it keeps the finished cities"


def require_engine(engine: str) -> None:
    """Refuse an engine that cannot run, before the work.

    Args:
        engine: name of the engine.

    Raises:
        DatasetError: there is no such engine.
        ExtraMissingError: Ray is not installed.
    """
    if engine not in ENGINES:
        raise DatasetError(f"engine: {engine!r} is unknown; give {' or '.join(ENGINES)}", field="engine")
    if engine == "ray":
        try:
            import ray  # noqa: F401
        except ModuleNotFoundError as error:
            raise extra_missing("--engine ray", "ray", error) from error


def simulate_archives(
    plans: Sequence[PackPlan],
    place: ArchivePlace,
    grid: ViewGrid,
    *,
    engine: Engine = "local",
    workers: int | None = None,
    report: Report = lambda *_: None,
    warn: Callable[[str], None] = lambda _: None,
) -> None:
    """Make the archives that do not exist yet.

    Args:
        plans: the cities.
        place: where the archives go.
        grid: the view grid.
        engine: ``local`` or ``ray``.
        workers: cities at the same time; None takes one per core, and on a cluster of Ray all of its cores.
        report: called with the name of the stage, cities done, and all cities.
        warn: called with a line of text if a process dies.

    Raises:
        StreetfixError: an archive cannot be made, or its process died in every attempt.
    """
    require_engine(engine)
    place.create()
    run = secrets.token_hex(4)
    tasks = []
    for plan in plans:
        if place.has(archive_name(plan)):
            place.clear(archive_name(plan))  # a process may have been killed after it published the archive
        else:
            tasks.append(CityTask(plan, grid, place, run, code_of_cities()))
    done = len(plans) - len(tasks)

    def count() -> None:
        nonlocal done
        done += 1
        report("training cities", done, len(plans))

    report("training cities", done, len(plans))
    if not tasks:
        return
    try:
        (_run_local if engine == "local" else _run_ray)(tasks, workers, count, warn)
    finally:
        for task in tasks:  # what processes left that were killed
            place.clear(task.name, run)


def attempt(task: CityTask) -> Failure | None:
    """Make an archive; return the error if it cannot be made.

    Args:
        task: city and place.
    """
    try:
        make_archive(task)
    except StreetfixError as error:
        return type(error).__name__, error.message, error.field
    except Exception as error:  # the other process raises it again
        return type(error).__name__, traceback.format_exc(), ""
    return None


def _raise(task: CityTask, failure: Failure) -> None:
    name, message, field = failure
    kind = getattr(errors, name, None)
    if isinstance(kind, type) and issubclass(kind, StreetfixError):
        raise kind(message, field=field)
    if name == "MemoryError":
        raise DatasetError(f"{task.name}: the memory is full; give fewer --workers, and {_GOES_ON}", field="workers")
    raise RuntimeError(f"{task.name} failed:\n{message}")


def _died(task: CityTask, how: str, attempts: int, most: int, warn: Callable[[str], None]) -> None:
    """Report a process that died; raise if the city has no attempt left."""
    if attempts >= most:
        raise DatasetError(
            f"{task.name}: its process {how} in each of {most} attempts; give fewer --workers, and {_GOES_ON}",
            field="workers",
        )
    warn(f"{task.name}: its process {how}; another process simulates the city again")


# -- processes of this machine ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _Running:
    """A process that makes an archive."""

    task: CityTask
    attempts: int
    process: BaseProcess
    pipe: Connection


def _run_local(
    tasks: Sequence[CityTask], workers: int | None, on_done: Callable[[], None], warn: Callable[[str], None]
) -> None:
    """Make each archive in a process of its own, so that its memory is free afterwards."""
    workers = workers or os.cpu_count() or 1
    waiting = deque((task, 1) for task in tasks)
    running: list[_Running] = []
    try:
        while waiting or running:
            while waiting and len(running) < workers:
                running.append(_started(*waiting.popleft()))
            wait([each.pipe for each in running])
            for each in [each for each in running if each.pipe.poll()]:
                try:
                    failure: Failure | Literal["died"] | None = each.pipe.recv()
                except EOFError:
                    failure = "died"
                each.process.join()
                each.pipe.close()
                running.remove(each)
                if failure == "died":
                    _died(each.task, _how(each.process.exitcode), each.attempts, LOCAL_ATTEMPTS, warn)
                    waiting.appendleft((each.task, each.attempts + 1))
                elif failure is not None:
                    _raise(each.task, failure)
                else:
                    on_done()
    finally:
        for each in running:
            each.process.kill()  # an archive is complete or absent, so nothing is left half
        for each in running:
            each.process.join()
            each.pipe.close()


def _started(task: CityTask, attempts: int) -> _Running:
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_in_process, args=(sender, task), name=task.name, daemon=True)
    process.start()
    sender.close()  # so that the end of the process closes the pipe
    return _Running(task, attempts, process, receiver)


def _in_process(pipe: Connection, task: CityTask) -> None:
    """Make an archive and send the failure or None."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the parent, which ends its processes
    threading.Thread(target=_end_with_parent, daemon=True).start()
    with suppress(BrokenPipeError):  # the parent has died, and this process ends too
        pipe.send(attempt(task))


def _end_with_parent() -> None:
    """End this process when its parent has died, so that no process works for nobody."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


def _how(exitcode: int | None) -> str:
    if exitcode is not None and exitcode < 0:
        name = signal.Signals(-exitcode).name
        return f"was killed by {name}" + (" (is the memory full?)" if name == "SIGKILL" else "")
    return f"ended with code {exitcode}"


# -- Ray ----------------------------------------------------------------------------------------------------------------------------------


def _largest_memory(nodes: Sequence[Mapping[str, Any]]) -> float:
    """Return the memory of the largest machine that takes tasks, bytes. The head of a cluster often has no cores for them."""
    resources = [node["Resources"] for node in nodes if node["Alive"]]
    return max((each.get("memory", 0.0) for each in resources if each.get("CPU", 0.0) >= 1), default=0.0)


def _run_ray(
    tasks: Sequence[CityTask], workers: int | None, on_done: Callable[[], None], warn: Callable[[str], None]
) -> None:
    """Make each archive as a task of Ray: on the cluster that ``RAY_ADDRESS`` names, else on this machine."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # Ray would send statistics to its vendor
    import ray
    from ray.exceptions import NodeDiedError, OutOfMemoryError, WorkerCrashedError

    own = not ray.is_initialized()
    if own and (address := os.environ.get("RAY_ADDRESS")):
        ray.init(address=address, log_to_driver=False)
    elif own:
        # Ray's default niceness of 15 would let every other program go first.
        os.environ.setdefault("RAY_worker_niceness", "0")
        ray.init(address="local", num_cpus=workers or os.cpu_count(), include_dashboard=False, log_to_driver=False)
    pending: dict[Any, tuple[CityTask, int]] = {}
    try:
        cores = int(ray.cluster_resources().get("CPU", 1))
        # Ray's own retries would not be reported.
        make = ray.remote(num_cpus=1, max_retries=0)(attempt)
        waiting = deque((task, 1) for task in tasks)
        while waiting or pending:
            # More than run at once, so that no core waits for this process.
            while waiting and len(pending) < (workers or 2 * cores):
                task, attempts = waiting.popleft()
                # A task that asks for more than any machine has would wait for ever.
                memory = min(task.memory_bytes, int(0.9 * _largest_memory(ray.nodes())))
                pending[make.options(memory=memory).remote(task)] = task, attempts
            for done in ray.wait(list(pending), timeout=_LOOK_EVERY_S)[0]:
                task, attempts = pending.pop(done)
                try:
                    failure = ray.get(done)
                except (WorkerCrashedError, NodeDiedError, OutOfMemoryError) as error:
                    _died(task, f"was lost ({type(error).__name__})", attempts, RAY_ATTEMPTS, warn)
                    waiting.appendleft((task, attempts + 1))
                    continue
                if failure is not None:
                    _raise(task, failure)
                on_done()
    finally:
        for each in pending:
            ray.cancel(each, force=True)
        if own:
            ray.shutdown()
