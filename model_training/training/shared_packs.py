"""Make the packs of a training that several processes share."""

import os
import time
from collections.abc import Callable
from pathlib import Path

from model_training.training.packs import PackPlan, make_packs
from model_training.training.processes import Processes
from service.imaging.view_grid import ViewGrid

#: Time between two looks at the packs that other processes make, seconds.
LOOK_EVERY_S = 1.0


def make_packs_together(
    plans: list[PackPlan],
    root: Path,
    grid: ViewGrid,
    together: Processes,
    *,
    workers: int | None = None,
    report: Callable[[str, int, int], None] = lambda *_: None,
) -> list[Path]:
    """Make the packs that do not exist yet. Each training process makes a part, and returns when all packs exist.

    Args:
        plans: the cities.
        root: folder of the packs.
        grid: the view grid.
        together: processes that train together; all call this function with the same arguments.
        workers: processes that simulate, for each training process; None for one per core, shared by the training processes
            of a machine.
        report: called with the name of the stage, cities done, and all cities of this process, then of all processes.

    Returns:
        Folders of all packs.

    Raises:
        DatasetError: the training processes see different folders.
    """
    if together.count == 1:
        return make_packs(plans, root, grid, workers=workers, report=report)
    together.require_shared(root, "packs")
    folders = [root / plan.stem for plan in plans]
    missing = [plan for plan, folder in zip(plans, folders, strict=True) if not folder.exists()]
    together.wait()  # until all have looked, so that they share the same list
    own = missing[together.rank :: together.count]
    workers = workers or max(1, (os.cpu_count() or 1) // together.local_count)
    make_packs(own, root, grid, workers=workers, report=report)
    done = len(folders) - len(missing)
    while done < len(folders):  # the others still simulate, perhaps for an hour
        time.sleep(LOOK_EVERY_S)
        done = sum(folder.exists() for folder in folders)
        report("all training cities", done, len(folders))
    together.wait()
    return folders
