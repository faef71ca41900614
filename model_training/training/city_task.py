"""Make the archive of one training city. The result depends on nothing but the task, so any process on any machine may make it."""

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from pathlib import Path

import cv2
from threadpoolctl import threadpool_limits

import model_training
import service
from model_training.training.archive_places import ArchivePlace
from model_training.training.city_archive import archive_name, kinds_of, shape_of, write_archive
from model_training.training.packs import PackPlan, make_pack
from service.errors import DatasetError
from service.imaging.view_grid import ViewGrid

#: Memory of a process without the arrays of its city: the programs and the scene, bytes (decision 0192).
PROCESS_BYTES = 512 << 20
#: Code that decides what an archive contains: files, and folders with their ``.py`` and ``.so`` files.
_CODE = (
    (
        model_training,
        (
            "simulation",
            "importing/stereo.py",
            "training/packs.py",
            "training/matched_views.py",
            "training/city_archive.py",
        ),
    ),
    (service, ("imaging", "geometry", "registration/points.py")),
)
#: Packages that decide it too, besides OpenCV, whose package has several names.
_PACKAGES = ("numpy", "scipy", "shapely", "embreex")


@dataclass(frozen=True, slots=True)
class CityTask:
    """All that a process needs to make an archive. It can be pickled.

    Attributes:
        plan: the city.
        grid: the view grid.
        place: where the archive goes.
        run: name of the command, part of the names of temporary files.
        code: hash of the code of the process that planned the task (``code_of_cities``).
    """

    plan: PackPlan
    grid: ViewGrid
    place: ArchivePlace
    run: str
    code: str

    @property
    def name(self) -> str:
        """File name of the archive."""
        return archive_name(self.plan)

    @property
    def memory_bytes(self) -> int:
        """Memory of a process that makes the archive, bytes: an upper estimate."""
        counts = (self.plan.places, self.plan.places * self.plan.queries_a_place)
        arrays = sum(
            count * shape_of(extension, self.grid).content_bytes
            for count, kind in zip(counts, kinds_of(self.plan), strict=True)
            for extension in kind.fields
        )
        return PROCESS_BYTES + 2 * arrays  # the arrays, and the pages of their files


def make_archive(task: CityTask) -> None:
    """Simulate a city and publish its archive, unless it is there.

    One thread does the work. So the number of cores cannot change the order of a sum.

    Args:
        task: city and place.

    Raises:
        DatasetError: this process has other code than the one that planned the task, or the archive cannot be written.
        BundleError: the store does not take the archive.
    """
    if task.code != code_of_cities():
        raise DatasetError(
            f"{task.name}: this process has another build of streetfix, or another release of opencv, {', '.join(_PACKAGES[:-1])} or "
            f"{_PACKAGES[-1]}, than the process that started the command; install the same ones on all machines",
            field="engine",
        )
    if task.place.has(task.name):  # made by an earlier attempt that was lost before it could say so
        return
    try:
        with threadpool_limits(limits=1), task.place.scratch(task.name, task.run) as folder:
            pack, made = folder / task.plan.stem, folder / task.name
            make_pack(task.plan, pack, task.grid)
            write_archive(pack, task.plan, task.grid, made)
            task.place.put(task.name, made)
    except (OSError, DatasetError) as error:
        # Another process may have published the same archive meanwhile, and removed the temporary files of this one.
        if task.place.has(task.name):
            return
        if isinstance(error, DatasetError):
            raise
        raise DatasetError(
            f"{task.place.full_name(task.name)}: the archive cannot be written ({error.strerror or error}); check the disk and the "
            "permissions, or choose another --out, and run the command again: finished cities are kept",
            field="out",
        ) from error


@cache
def code_of_cities() -> str:
    """Return a hash of the code and of the versions of the packages that decide what an archive contains."""
    found = hashlib.sha256(" ".join([cv2.__version__, *(version(name) for name in _PACKAGES)]).encode())
    for file in _files():
        found.update(file.name.encode() + file.read_bytes())
    return found.hexdigest()


def _files() -> Iterator[Path]:
    """Yield the files of ``_CODE``."""
    for package, parts in _CODE:
        for part in parts:
            path = Path(package.__path__[0]) / part
            for file in sorted(path.iterdir()) if path.is_dir() else (path,):
                if file.suffix in (".py", ".so"):
                    yield file
