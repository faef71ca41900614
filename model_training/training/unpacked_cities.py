"""Unpack the city archives of a training into packs. Each machine may have packs of its own."""

from collections.abc import Callable, Sequence
from pathlib import Path

from model_training.training.archive_places import ArchivePlace, clear_beside, scratch_beside
from model_training.training.archive_reader import unpack_archive
from model_training.training.city_archive import archive_name
from model_training.training.packs import PackPlan
from model_training.training.processes import Processes
from service.errors import DatasetError
from service.imaging.view_grid import ViewGrid


def unpack_together(
    plans: Sequence[PackPlan],
    place: ArchivePlace,
    root: Path,
    grid: ViewGrid,
    together: Processes,
    *,
    report: Callable[[str, int, int], None] = lambda *_: None,
) -> list[Path]:
    """Unpack the archives whose packs do not exist yet. The processes of a machine each unpack a part.

    Args:
        plans: the cities.
        place: where the archives are.
        root: folder of the packs. Machines may share it, or each has its own.
        grid: the view grid.
        together: processes that train together; all call this function with the same arguments.
        report: called with the name of the stage, cities done, and all cities of this process.

    Returns:
        Folders of all packs.

    Raises:
        DatasetError: an archive is missing or damaged, or a pack cannot be written.
        BundleError: the store cannot be read.
    """
    root.mkdir(parents=True, exist_ok=True)
    folders = [root / plan.stem for plan in plans]
    for folder in folders:
        if folder.exists():
            clear_beside(folder)  # a process may have been killed after it renamed the folder
    missing = [(plan, folder) for plan, folder in zip(plans, folders, strict=True) if not folder.exists()]
    absent = [plan for plan, _ in missing if not place.has(archive_name(plan))]
    if absent:
        raise DatasetError(
            f"cities_from: {place.full_name(archive_name(absent[0]))} is missing, and {len(absent)} of {len(plans)} cities in all; "
            "simulate them there first (streetfix simulate-training), with the same --recipe and --cities",
            field="cities_from",
        )
    together.wait()  # until all processes of this machine have looked, so that they share the same list
    own = missing[together.local_rank :: together.local_count]
    if own:
        report("unpacking cities", 0, len(own))
    for done, (plan, folder) in enumerate(own, 1):
        _unpack(plan, place, folder, grid)
        report("unpacking cities", done, len(own))
    together.wait()
    return folders


def _unpack(plan: PackPlan, place: ArchivePlace, folder: Path, grid: ViewGrid) -> None:
    """Unpack one archive. The pack appears only when it is complete."""
    name = archive_name(plan)
    try:
        with scratch_beside(folder, "unpacked") as scratch:
            unpack_archive(place.fetched(name, scratch), plan, grid, scratch / folder.name, name=place.full_name(name))
            (scratch / folder.name).rename(folder)
    except (OSError, DatasetError) as error:
        # A machine that shares the folder of the packs may have unpacked the same city, and removed the temporary files of this process.
        if not folder.exists():
            if isinstance(error, DatasetError):
                raise
            raise DatasetError(
                f"{folder}: the city cannot be unpacked ({error.strerror or error}); check the disk and the permissions, or choose "
                "another --packs",
                field="packs",
            ) from error
    clear_beside(folder)
