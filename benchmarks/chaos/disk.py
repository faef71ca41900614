"""A small disk that can be full: a tmpfs where mounting is allowed, else a limit on the file sizes of the service."""

import errno
import os
import resource
import subprocess
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

_CHUNK = bytes(2**18)
#: Upper limit of the filler file, whatever size the disk reports.
_MOST_BYTES = 2**31


class Disk:
    """Folder whose disk can be full.

    Attributes:
        folder: folder on the disk.
        is_mounted: whether the disk is its own file system. If not, "full" means that the service's processes may not
            write any file.
        is_full: whether the disk is full now.
    """

    def __init__(self, folder: Path, *, is_mounted: bool) -> None:
        self.folder, self.is_mounted, self.is_full = folder, is_mounted, False
        self._limited: set[int] = set()

    def fill(self, pids: Iterable[int]) -> None:
        """Fill the disk to the last byte.

        Args:
            pids: processes of the service; processes that they start inherit the limit.

        Raises:
            OSError: writing failed for another reason than a full disk.
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
        """Free the disk again.

        Args:
            pids: processes of the service.
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
    """Provide a small disk for as long as the context lasts.

    Args:
        mib: size of the file system, MiB.
        may_mount: whether to try to mount; otherwise, or if mounting is not allowed, the disk is a plain folder.
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
            if is_mounted:  # lazily: a process that holds a file there must not block it
                subprocess.run(["umount", "--lazy", str(folder)], check=True)
