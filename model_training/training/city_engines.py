"""Make city archives in processes of this machine, or as tasks of Ray.

A process that dies loses its own unfinished city and no other.
"""

import os
import secrets
from collections.abc import Callable, Sequence

from model_training.tasks.engines import Engine, require_engine, run_job
from model_training.tasks.job import Job, Share
from model_training.training.archive_places import ArchivePlace
from model_training.training.city_archive import archive_name
from model_training.training.city_task import CityTask, code_of_cities, make_archive
from model_training.training.packs import PackPlan
from service.errors import DatasetError
from service.imaging.view_grid import ViewGrid

#: Progress callback: stage, number done, number of all.
Report = Callable[[str, int, int], None]


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
        DatasetError: the engine or ``workers`` is not valid, or the process of a city died in every attempt.
        ExtraMissingError: the engine is not installed.
        StreetfixError: an archive cannot be made.
    """
    require_engine(engine, workers)
    place.create()
    run = secrets.token_hex(4)
    tasks = []
    for plan in plans:
        if place.has(archive_name(plan)):
            place.clear(archive_name(plan))  # a process may have been killed after it published the archive
        else:
            tasks.append(CityTask(plan, grid, place, run, code_of_cities()))
    done = len(plans) - len(tasks)

    def count(_: int) -> None:
        nonlocal done
        done += 1
        report("training cities", done, len(plans))

    report("training cities", done, len(plans))
    if not tasks:
        return
    job = Job(
        tasks,
        order=range(len(tasks)),
        do=_make,
        name_of=lambda task: task.name,
        memory_of=lambda task: task.memory_bytes,
        after_death="another process simulates the city again",
        remedy="give fewer --workers, and run the command again: it keeps the finished cities",
        error=DatasetError,
        on_done=count,
        warn=warn,
    )
    try:
        run_job(engine, job, workers, usual_workers=os.cpu_count() or 1)
    finally:
        for task in tasks:  # what processes left that were killed
            place.clear(task.name, run)


def _make(task: CityTask, _: Share) -> None:
    make_archive(task)
