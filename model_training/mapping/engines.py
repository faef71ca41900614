"""Run the tiles of a map in processes of this machine, or as tasks of Ray.

A tile's folder is its only result. A process that dies loses no finished tile and no finished part of its own tile.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from model_training.mapping.build_tile import THREADS, Share
from model_training.tasks.engines import Engine, run_job
from model_training.tasks.job import Job
from model_training.tasks.local import workers_that_fit
from service.errors import BundleError
from service.heap import limit_heap

#: Memory of a process that builds a tile: a part for the programs, and a part for each scan, bytes (decision 0166).
PROCESS_BYTES, SCAN_BYTES = 300 << 20, 320 << 10
#: Arrays of this size or more go back to the system as soon as they are free: scans are smaller, sums of voxels are larger.
_MAPPED_BYTES = 2 << 20

#: Progress callback: index of a task, and its finished share, 0 to 1.
OnProgress = Callable[[int, float], None]


class Tile(Protocol):
    """A tile to build or to update. It can be pickled."""

    @property
    def name(self) -> str:
        """Name of the tile in messages."""
        ...

    @property
    def numbers(self) -> NDArray[np.int64]:
        """Indices of the scans that the tile reads (K,)."""
        ...


T = TypeVar("T", bound=Tile)


def run(
    engine: Engine,
    tasks: Sequence[T],
    do: Callable[[T, Share], None],
    *,
    memory_of: Callable[[T], int],
    remedy: str,
    workers: int | None,
    on_progress: OnProgress,
    warn: Callable[[str], None],
) -> None:
    """Build or update all tiles.

    Args:
        engine: ``local`` or ``ray``.
        tasks: the tiles.
        do: builds or updates a tile, and reports its finished share. Other processes import it by its name.
        memory_of: returns the memory that a process needs for a tile, bytes.
        remedy: what helps if processes die or the memory is full, for the error.
        workers: number of processes; None takes as many as cores and memory allow, and on a cluster of Ray all of its cores.
        on_progress: called with the progress of each tile.
        warn: called with a line of text if a process dies.

    Raises:
        StreetfixError: a tile cannot be built or updated.
        BundleError: the process of a tile died in every attempt.
    """
    if not tasks:
        return
    job = Job(
        tasks,
        # The longest tile first, so that none of them runs alone at the end.
        order=sorted(range(len(tasks)), key=lambda index: -len(tasks[index].numbers)),
        do=partial(_with_small_heap, do),
        name_of=lambda task: task.name,
        memory_of=memory_of,
        after_death="the tile goes on in another process",
        remedy=f"{remedy}, and run the command again: it goes on with the unfinished tiles",
        error=BundleError,
        on_done=lambda index: on_progress(index, 1.0),
        warn=warn,
        on_progress=on_progress,
    )
    run_job(engine, job, workers, usual_workers=workers_that_fit(job))


def memory_of(task: Tile) -> int:
    """Return the memory that a process needs for the scans of a tile, bytes: an upper estimate.

    Args:
        task: the tile.
    """
    return PROCESS_BYTES + SCAN_BYTES * len(task.numbers)


def _with_small_heap(do: Callable[[T, Share], None], task: T, share: Share) -> None:
    limit_heap(THREADS, mapped_bytes=_MAPPED_BYTES)
    do(task, share)
