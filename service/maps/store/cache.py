"""A folder of tiles that several processes share. It is bounded: the least recently used tiles make room for new ones.

``CACHE/KEY/tiles/VERSION`` is the folder of a tile, and ``CACHE/KEY/VERSION`` the folder of a version of a map. Such a folder is
whole or missing. A process fills ``.NAME.partial`` beside it, whose lock it holds, and renames it. Whoever wants the same folder waits
for the lock. The system releases the lock of a killed process, so the next process takes over.

A file stays readable for a process that has it open or mapped, also after its folder is deleted. So a tile in use may be deleted.
"""

import errno
import fcntl
import os
import shutil
import stat
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from io import FileIO
from pathlib import Path

from service.errors import BundleError
from service.maps.manifest import TILES_FOLDER

_PARTIAL, _DELETED = ".partial", ".deleted"
#: Its lock guards the bound. Its content is the size of all tiles, never too small; or nothing, if the tiles must be counted.
_LOCK = ".lock"
#: Share of the bound that is freed beyond what a new tile needs. Otherwise each tile in a full cache would count all tiles again.
_SPARE_SHARE = 0.02


def default_folder() -> Path:
    """Return the usual folder of the cache: ``streetfix/tiles`` in ``$XDG_CACHE_HOME`` or ``~/.cache``.

    Raises:
        BundleError: the user has no home folder.
    """
    try:
        base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    except RuntimeError as error:
        raise BundleError(
            "maps in object storage need a cache, and the user of the service has no home folder; set STREETFIX_TILE_CACHE",
            field="tile_cache",
        ) from error
    return base / "streetfix" / "tiles"


@dataclass(frozen=True, slots=True)
class TileCache:
    """The cache in a folder.

    Attributes:
        folder: the folder; created when it is needed.
        most_bytes: bound of all tiles together, also of those that are being fetched. The shared files of the maps are not counted.
    """

    folder: Path
    most_bytes: int

    def clean(self) -> None:
        """Delete what killed processes left. Folders that another process works on stay.

        Raises:
            BundleError: the folder cannot be created or read.
        """
        with self.error_context():
            self.folder.mkdir(parents=True, exist_ok=True)
            for folder in [*self.folder.glob("*"), *self.folder.glob(f"*/{TILES_FOLDER}")]:
                for each in list(folder.iterdir()) if folder.is_dir() else []:
                    if each.name.endswith((_PARTIAL, _DELETED)):
                        _delete_if_free(each)

    def once(self, target: Path, fill: Callable[[Path], None]) -> None:
        """Create a folder, unless another process has or does.

        Args:
            target: the folder, below the folder of the cache.
            fill: writes the content into the folder that it gets. If it raises, nothing stays.

        Raises:
            BundleError: the file system reports an error.
        """
        with self.error_context():
            make_once(target, fill)

    def reserve(self, partial: Path, sizes: Mapping[str, int]) -> None:
        """Delete least recently used tiles until new files fit, and create these files with their sizes.

        Args:
            partial: folder of the new tile.
            sizes: bytes of each file, by its path in the folder.

        Raises:
            BundleError: the files are larger than the bound, or the disk is full.
        """
        needed = sum(sizes.values())
        if needed > self.most_bytes:
            raise BundleError(
                f"{self.folder}: a tile has {needed} bytes, but tile_cache_bytes is {self.most_bytes}; set "
                "STREETFIX_TILE_CACHE_BYTES to several times the size of a tile",
                field="tile_cache_bytes",
            )
        with self.error_context(), self._alone() as total:
            known = total.get()
            if known is None or known + needed > self.most_bytes:
                total.set(None)
                known = self._make_room(needed)
            total.set(known + needed)
            for name, size in sizes.items():
                file = partial / name
                file.parent.mkdir(parents=True, exist_ok=True)
                with file.open("wb") as stream:
                    stream.truncate(size)
        free = shutil.disk_usage(self.folder).free
        if needed > free:
            raise _no_space(self.folder)

    def delete(self, folder: Path) -> None:
        """Delete a folder, which others see whole or not at all.

        Args:
            folder: of a tile or of a version.

        Raises:
            BundleError: the file system reports an error.
        """
        with self.error_context():
            self._delete(folder)
            if self.folder.is_dir():
                with self._alone() as total:  # tiles may be the last to have a link to a file of a version
                    total.set(None)

    def _delete(self, folder: Path) -> None:
        doomed = folder.parent / f".{folder.name}.{os.getpid()}-{time.monotonic_ns()}{_DELETED}"
        with suppress(FileNotFoundError):  # another process deletes it too
            folder.rename(doomed)
            shutil.rmtree(doomed, ignore_errors=True)

    def _make_room(self, needed: int) -> int:
        """Count all tiles, and delete the least recently used ones until there is room; return the size of the others."""
        tiles = [_Kept.of(each) for each in self.folder.glob(f"*/{TILES_FOLDER}/*") if not each.name.endswith(_DELETED)]
        kept, most = sum(each.size for each in tiles), self.most_bytes - needed
        if kept <= most:
            return kept
        for oldest in sorted(tiles, key=lambda each: each.used):
            if kept <= most - _SPARE_SHARE * self.most_bytes:
                break
            if oldest.path.name.startswith("."):  # being fetched
                continue
            self._delete(oldest.path)
            kept -= oldest.size
        return kept

    @contextmanager
    def _alone(self) -> Iterator["_Total"]:
        """Let no other process delete or reserve inside the context."""
        with os.fdopen(os.open(self.folder / _LOCK, os.O_RDWR | os.O_CREAT, 0o644), "r+b", buffering=0) as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield _Total(lock)

    @contextmanager
    def error_context(self) -> Iterator[None]:
        """Turn errors of the file system inside the context into errors that name the folder and the setting.

        Raises:
            BundleError: the file system reports an error.
        """
        try:
            yield
        except OSError as error:
            if error.errno == errno.ENOSPC:
                raise _no_space(self.folder) from error
            raise BundleError(
                f"{error.filename or self.folder}: the cache of maps cannot be used ({error.strerror}); get write access, or set "
                "STREETFIX_TILE_CACHE to another folder",
                field="tile_cache",
            ) from error


class _Total:
    """The size of all tiles, in the content of the lock. An earlier release empties it, so the tiles are then counted again."""

    def __init__(self, file: FileIO) -> None:
        self._file = file

    def get(self) -> int | None:
        """Return the bytes; None if they are unknown."""
        self._file.seek(0)
        text = self._file.read()
        return int(text) if text.isdigit() else None

    def set(self, size: int | None) -> None:
        """Store the bytes; None if they are unknown."""
        self._file.seek(0)
        self._file.truncate()
        if size is not None:
            self._file.write(b"%d" % size)


@dataclass(frozen=True, slots=True)
class _Kept:
    path: Path
    size: int
    used: float

    @classmethod
    def of(cls, path: Path) -> "_Kept":
        size, used = 0, 0.0
        with suppress(FileNotFoundError):
            used = path.stat().st_mtime
        for folder, _, names in os.walk(path):
            for name in names:
                with suppress(FileNotFoundError):
                    status = (Path(folder) / name).stat()
                    size += (
                        status.st_size if status.st_nlink == 1 else 0
                    )  # a link to a shared file of the map takes no space
        return cls(path, size, used)


def make_once(target: Path, fill: Callable[[Path], None]) -> None:
    """Create a folder, unless another process has or does.

    Args:
        target: the folder.
        fill: writes the content into the folder that it gets. If it raises, nothing stays.

    Raises:
        OSError: the file system reports an error.
    """
    partial = target.parent / f".{target.name}{_PARTIAL}"
    while not target.is_dir():
        try:
            partial.mkdir(parents=True, exist_ok=True)
        except FileExistsError:  # also if another process removed the folder before mkdir could see that it is one
            if _is_no_folder(partial):
                raise
            continue
        with _locked(partial) as is_mine:
            if not is_mine:  # another process has finished or given up meanwhile
                continue
            if target.is_dir():
                partial.rmdir()
                continue
            try:
                for left in partial.iterdir():  # by a killed process
                    shutil.rmtree(left) if left.is_dir() else left.unlink()
                fill(partial)
                sync_tree(partial)  # otherwise a crash of the machine could leave a whole folder of damaged files
                partial.rename(target)
            except BaseException:
                shutil.rmtree(partial, ignore_errors=True)
                raise


def is_used_now(folder: Path) -> bool:
    """Mark a folder as used now; return False if it is missing.

    Args:
        folder: of a tile.
    """
    try:
        os.utime(folder)
    except FileNotFoundError:
        return False
    return True


@contextmanager
def _locked(folder: Path) -> Iterator[bool]:
    """Lock a folder, and yield whether it is still at its path."""
    try:
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except FileNotFoundError:
        yield False
        return
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield _is_at(descriptor, folder)
    finally:
        os.close(descriptor)


def _is_at(descriptor: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False


def _is_no_folder(path: Path) -> bool:
    """Return whether something other than a folder is at a path: one look, because others create and delete meanwhile."""
    try:
        return not stat.S_ISDIR(path.stat().st_mode)
    except FileNotFoundError:
        return False


def _delete_if_free(folder: Path) -> None:
    try:
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except OSError:  # gone meanwhile, or no folder
        return
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        shutil.rmtree(folder, ignore_errors=True)
    except BlockingIOError:  # another process works on it
        pass
    finally:
        os.close(descriptor)


def sync_tree(folder: Path) -> None:
    """Flush a folder and its files to the disk.

    Args:
        folder: the folder.

    Raises:
        OSError: the file system reports an error.
    """
    for inner, _, names in os.walk(folder):
        for path in [*(Path(inner) / name for name in names), Path(inner)]:
            descriptor = os.open(path, os.O_RDONLY)
            try:
                os.fsync(descriptor)
            finally:
                os.close(descriptor)


def _no_space(folder: Path) -> BundleError:
    return BundleError(
        f"{folder}: the disk is full; free disk space, lower STREETFIX_TILE_CACHE_BYTES, or set STREETFIX_TILE_CACHE to a folder on "
        "another disk",
        field="tile_cache",
    )
