"""Which tiles a process has checked. The versions of a map share this, so a new version checks only the tiles that it changed."""

import hashlib
import os
import threading
from collections import OrderedDict
from enum import IntEnum
from pathlib import Path

#: Largest number of tiles that are remembered, about 200 bytes each.
MOST_REMEMBERED = 100_000


class Checked(IntEnum):
    """What a process has checked of the files of a tile."""

    NOTHING = 0
    HASHES = 1
    """the hashes of all files that the service reads"""
    ALL = 2
    """the hashes, and every index in the files"""


class CheckedTiles:
    """Remembers which files of tiles this process has checked. Threads may share it.

    An entry holds for the version of a tile and for the mark of its folder (``mark_of``). Another mark is not known, so files that were
    replaced or written since are checked again.
    """

    def __init__(self) -> None:
        self._known: OrderedDict[tuple[str, bytes], Checked] = OrderedDict()
        self._changing = threading.Lock()

    def get(self, version: str, mark: bytes) -> Checked:
        """Return what was checked.

        Args:
            version: of the tile.
            mark: of its folder.
        """
        with self._changing:
            return self._known.get((version, mark), Checked.NOTHING)

    def add(self, version: str, mark: bytes, checked: Checked) -> None:
        """Remember what was checked.

        Args:
            version: of the tile, as its manifest says.
            mark: of its folder, from before the check.
            checked: what was checked without an error.
        """
        with self._changing:
            self._known[version, mark] = max(checked, self._known.pop((version, mark), Checked.NOTHING))
            while len(self._known) > MOST_REMEMBERED:
                self._known.popitem(last=False)


def mark_of(folder: Path) -> bytes:
    """Return the mark of a folder: a hash of the path, device, inode, size and modification time of each of its files.

    The mark stays if the folder is renamed, or if its files are linked into another folder. It changes if a file is replaced, written,
    added or removed. A write that puts the old size and modification time back does not change it.

    Args:
        folder: of a tile. The mark of a missing folder is that of an empty one.
    """
    found = []
    for inner, _, names in os.walk(folder):
        for name in names:
            path = os.path.join(inner, name)
            try:
                status = os.stat(path)
            except OSError:  # somebody removes it meanwhile, and whoever opens the tile says so
                continue
            place = os.path.relpath(path, folder)
            found.append((place, status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns))
    return hashlib.sha256(repr(sorted(found)).encode()).digest()
