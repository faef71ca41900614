"""The tiles of a build or of an update of a tiled map. Finished tiles stay among its parts until the map is complete."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol, TypeVar

import numpy as np

from model_training.mapping import engines
from model_training.mapping.build import Report
from model_training.mapping.build_tile import Share
from model_training.mapping.tile_area import Square
from model_training.mapping.work import BuildCache, remove
from model_training.tasks.engines import Engine
from service.errors import BundleError

#: Start of the name of a tile's folder among the parts.
_PREFIX = "tile_"


class TileResult(engines.Tile, Protocol):
    """A tile to build or to update, with its result."""

    @property
    def folder(self) -> Path:
        """Folder of the finished tile (``folder_of``)."""
        ...

    @property
    def is_finished(self) -> bool:
        """Whether the result is there."""
        ...


T = TypeVar("T", bound=TileResult)


def folder_of(work: BuildCache, square: Square, key: str) -> Path:
    """Return the folder of a finished tile.

    Args:
        work: store of the parts.
        square: square of the tile.
        key: hash of all inputs of the tile.
    """
    return (work.folder / f"{_PREFIX}{square.column}_{square.row}_{key}").resolve()


def is_of_tile(name: str) -> bool:
    """Return whether a name among the parts is that of a tile, or of the parts of a tile.

    Args:
        name: name of a file or folder.
    """
    return name.removeprefix(".").startswith(_PREFIX)


def finish_tiles(
    engine: Engine,
    tasks: Sequence[T],
    do: Callable[[T, Share], None],
    work: BuildCache,
    *,
    memory_of: Callable[[T], int],
    remedy: str,
    workers: int | None,
    report: Report,
    warn: Callable[[str], None],
) -> None:
    """Do all tiles that an earlier attempt did not finish. Remove the tiles of other inputs.

    Args:
        engine: ``local`` or ``ray``.
        tasks: all tiles.
        do: builds or updates a tile, and reports its finished share. Other processes import it by its name.
        work: store of the parts.
        memory_of: returns the memory that a process needs for a tile, bytes.
        remedy: what helps if processes die or the memory is full, for the error.
        workers: number of tiles at the same time; None takes as many as cores and memory allow.
        report: called with the finished scans of all tiles.
        warn: called with a line of text if a process dies.

    Raises:
        StreetfixError: a tile cannot be built or updated.
        BundleError: the process of a tile died in every attempt, or this process does not see a result.
    """
    _remove_others(work, tasks)
    left = [task for task in tasks if not task.is_finished]
    progress = _Progress(tasks, left, report)
    engines.run(
        engine,
        left,
        do,
        memory_of=memory_of,
        remedy=remedy,
        workers=workers,
        on_progress=progress,
        warn=warn,
    )
    if unseen := [task.name for task in left if not task.is_finished]:
        raise BundleError(
            f"{unseen[0]}: the finished tile is not in {work.folder}; put --out on a folder that all machines share",
            field="out",
        )


def _remove_others(work: BuildCache, tasks: Sequence[TileResult]) -> None:
    """Remove the tiles of other inputs, and their parts."""
    wanted = {task.folder.name for task in tasks}
    for path in work.folder.iterdir():
        if is_of_tile(path.name) and not any(path.name.removeprefix(".").startswith(name) for name in wanted):
            remove(path)


class _Progress:
    """Add up the progress of the tiles, in scans.

    Args:
        tasks: all tiles.
        left: the tiles that are not finished.
        report: progress callback.
    """

    def __init__(self, tasks: Sequence[TileResult], left: Sequence[TileResult], report: Report) -> None:
        self._scans = np.array([len(task.numbers) for task in left], np.float64)
        self._shares = np.zeros(len(left))
        self._total = sum(len(task.numbers) for task in tasks)
        self._before = self._total - int(self._scans.sum())
        self._stage = f"scans of {len(tasks)} tiles"
        self._report = report
        self._report(self._stage, self._before, self._total)

    def __call__(self, index: int, share: float) -> None:
        """Store the progress of a tile and report the sum.

        Args:
            index: index of the tile among those that are not finished.
            share: its finished share, 0 to 1.
        """
        self._shares[index] = max(share, self._shares[index])
        self._report(self._stage, self._before + int(self._scans @ self._shares), self._total)
