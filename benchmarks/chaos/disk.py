"""A small disk that can be full: a tmpfs of its own where mounting is allowed, else a limit on the size of the service's files."""

import errno
import os
import resource
import subprocess
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

_CHUNK = bytes(2**18)
#: A disk is never filled for more than this, whatever it says of its size.
_MOST_BYTES = 2**31


class Disk:
    """A folder whose disk can be full.

    Attributes:
        folder: on it.
        is_mounted: whether it is a file system of its own. If not, being full means that the service's processes may write no file.
        is_full: now.
    """

    def __init__(self, folder: Path, *, is_mounted: bool) -> None:
        self.folder, self.is_mounted, self.is_full = folder, is_mounted, False
        self._limited: set[int] = set()

    def fill(self, pids: Iterable[int]) -> None:
        """No byte is left.

        Args:
            pids: of the service; those that they start inherit the limit.
        """
        self.is_full = True
        if not self.is_mounted:
            for pid in pids:
                self._limit(pid, 0)
                self._limited.add(pid)
            return
        with (self.folder / ".filler").open("ab", buffering=0) as file:
            for chunk in (_CHUNK, b"\0"):
                try:
                    while file.tell() < _MOST_BYTES:
                        if file.write(chunk) < len(chunk):
                            break
                except OSError as error:
                    if error.errno != errno.ENOSPC:
                        raise

    def free(self, pids: Iterable[int]) -> None:
        """There is space again.

        Args:
            pids: of the service.
        """
        self.is_full = False
        (self.folder / ".filler").unlink(missing_ok=True)
        for pid in {*pids, *self._limited} if self._limited else ():
            self._limit(pid, resource.RLIM_INFINITY)
        self._limited.clear()

    @staticmethod
    def _limit(pid: int, most: int) -> None:
        try:
            _, hard = resource.prlimit(pid, resource.RLIMIT_FSIZE)
            resource.prlimit(pid, resource.RLIMIT_FSIZE, (hard if most == resource.RLIM_INFINITY else most, hard))
        except ProcessLookupError:
            return


@contextmanager
def small_disk(mib: int, *, may_mount: bool = True) -> Iterator[Disk]:
    """A disk of so many MiB for as long as the context lasts.

    Args:
        mib: of a file system of its own.
        may_mount: whether to try; without, or where it is not allowed, it is a plain folder.
    """
    with tempfile.TemporaryDirectory(prefix="streetfix-chaos-") as name:
        folder = Path(name) / "disk"
        folder.mkdir()
        command = ["mount", "-t", "tmpfs", "-o", f"size={mib}m,mode=700", "streetfix-chaos", str(folder)]
        is_mounted = (
            may_mount
            and os.geteuid() == 0
            and subprocess.run(command, capture_output=True, check=False).returncode == 0
        )
        try:
            yield Disk(folder, is_mounted=is_mounted)
        finally:
            if is_mounted:  # lazily: a process that holds a file there must not keep it
                subprocess.run(["umount", "--lazy", str(folder)], check=True)
