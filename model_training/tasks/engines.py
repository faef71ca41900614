"""Run a job: in processes of this machine (``local``), or as tasks of Ray (``ray``).

Both engines call the same function for each task and nothing else, so both give the same result.
"""

from typing import Literal, get_args

from model_training.tasks.job import Job, T
from model_training.tasks.local import run_local
from model_training.tasks.ray_cluster import run_ray
from service.errors import DatasetError, extra_missing

Engine = Literal["local", "ray"]
ENGINES: tuple[Engine, ...] = get_args(Engine)


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


def run_job(engine: Engine, job: Job[T], workers: int | None, *, usual_workers: int) -> None:
    """Do all tasks of a job.

    Args:
        engine: ``local`` or ``ray``.
        job: the job.
        workers: number of processes at the same time; None takes ``usual_workers``, and on a cluster of Ray all of its cores.
        usual_workers: number of processes on this machine if ``workers`` is None.

    Raises:
        StreetfixError: a task failed, or its process died in every attempt.
        RuntimeError: a task failed with another error.
    """
    if engine == "local":
        run_local(job, workers or usual_workers)
    else:
        run_ray(job, workers, usual_workers=usual_workers)
