"""Do the tasks of a job as tasks of Ray."""

import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any

from model_training.tasks.job import EVERY_S, Attempt, Failure, Job, Share, T, Waiting, failure_of

#: How often a task is started before the job gives up, if its process dies. Machines of a cluster may be taken away.
ATTEMPTS = 4


class _Board:
    """Collects the progress of all tasks. It is an actor of Ray."""

    def __init__(self) -> None:
        self._shares: dict[int, float] = {}

    def put(self, index: int, share: float) -> None:
        self._shares[index] = share

    def take(self) -> dict[int, float]:
        found, self._shares = self._shares, {}
        return found


def _in_task(board: Any, index: int, do: Callable[[T, Share], None], task: T) -> Failure | None:
    return failure_of(do, task, lambda share: board.put.remote(index, share))


def _largest_memory(nodes: Sequence[Mapping[str, Any]]) -> float:
    """Return the memory of the largest machine that takes tasks, bytes. The head of a cluster often has no cores for them."""
    resources = [node["Resources"] for node in nodes if node["Alive"]]
    return max((each.get("memory", 0.0) for each in resources if each.get("CPU", 0.0) >= 1), default=0.0)


def run_ray(job: Job[T], workers: int | None, *, usual_workers: int) -> None:
    """Do each task as a task of Ray: on the cluster that ``RAY_ADDRESS`` names, else on this machine.

    Args:
        job: the job.
        workers: number of tasks at the same time; None takes all cores of the cluster.
        usual_workers: number of tasks at the same time if ``workers`` is None and there is no cluster.

    Raises:
        StreetfixError: a task failed, or its process died in every attempt.
        RuntimeError: a task failed with another error.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # Ray would send statistics to its vendor
    import ray
    from ray.exceptions import NodeDiedError, OutOfMemoryError, RayActorError, WorkerCrashedError

    own = not ray.is_initialized()
    if own and (address := os.environ.get("RAY_ADDRESS")):
        ray.init(address=address, log_to_driver=False)
    elif own:
        # Ray's default niceness of 15 would let every other program go first.
        os.environ.setdefault("RAY_worker_niceness", "0")
        ray.init(address="local", num_cpus=workers or usual_workers, include_dashboard=False, log_to_driver=False)
    pending: dict[Any, Attempt] = {}
    try:
        # More than run at once, so that no core waits for this process.
        most = workers or 2 * int(ray.cluster_resources().get("CPU", 1))
        board = ray.remote(num_cpus=0)(_Board).remote()
        # Ray's own retries would not be reported.
        in_task = ray.remote(num_cpus=1, max_retries=0)(_in_task)
        waiting = Waiting(job, ATTEMPTS)
        while waiting or pending:
            while waiting and len(pending) < most:
                attempt = waiting.take()
                task = job.tasks[attempt.index]
                # A task that asks for more than any machine has would wait for ever.
                memory = min(job.memory_of(task), int(0.9 * _largest_memory(ray.nodes())))
                pending[in_task.options(memory=memory).remote(board, attempt.index, job.do, task)] = attempt
            ready, _ = ray.wait(list(pending), timeout=EVERY_S)
            with suppress(RayActorError):  # the actor's machine is lost; the tasks still report their end
                for index, share in ray.get(board.take.remote()).items():
                    job.on_progress(index, share)
            for done in ready:
                attempt = pending.pop(done)
                try:
                    failure = ray.get(done)
                except (WorkerCrashedError, NodeDiedError, OutOfMemoryError) as error:
                    waiting.died(attempt, f"was lost ({type(error).__name__})")
                else:
                    waiting.ended(attempt, failure)
    finally:
        for each in pending:
            ray.cancel(each, force=True)
        if own:
            ray.shutdown()
