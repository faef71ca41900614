"""Room on the disk for what a worker counts, taken before it counts.

Prometheus' client library keeps the counts of several processes in memory-mapped sparse files. A store into a page for which the disk has
no block left ends the process with SIGBUS. So a full disk would end every worker at its next new count, and again after every
restart.
"""

import os
import struct
from pathlib import Path

#: Of each file: three times what the counts of all methods and codes take; each map adds 2.5 KiB.
RESERVED_BYTES = 256 * 2**10
#: Kinds of our metrics, as the library names its files: what they count stays when a process has ended, and what is true while it lives.
_COUNTS, _LIVE = ("counter", "histogram"), ("gauge_livesum",)
#: A file begins with the number of bytes that are used, an integer of four bytes in a field of eight.
_HEADER_BYTES = 8


def reserve(folder: Path) -> OSError | None:
    """Write the files of this process full of zeros, which the library takes for files without a count.

    Args:
        folder: that all workers share.

    Returns:
        Why there is no room; then no file is left. None if all are there.
    """
    paths = [folder / f"{kind}_{os.getpid()}.db" for kind in (*_COUNTS, *_LIVE)]
    try:
        for path in paths:
            with path.open("ab", buffering=0) as file:  # what an earlier process with this number has counted stays
                missing = RESERVED_BYTES - file.tell()
                while missing > 0:
                    missing -= file.write(bytes(missing))
    except OSError as error:
        for path in paths:
            path.unlink(missing_ok=True)
        return error
    return None


def release(folder: Path, pid: int) -> None:
    """Give back the room of a process that has ended; what it counted stays.

    Args:
        folder: that all workers share.
        pid: of the process.
    """
    for kind in _LIVE:  # what it had in hand it has no more
        (folder / f"{kind}_{pid}.db").unlink(missing_ok=True)
    for kind in _COUNTS:
        path = folder / f"{kind}_{pid}.db"
        try:
            with path.open("rb") as file:
                (used,) = struct.unpack("i", file.read(4))
        except (FileNotFoundError, struct.error):  # it has ended before it wrote it
            continue
        if used <= _HEADER_BYTES:
            path.unlink(missing_ok=True)
        else:
            os.truncate(path, used)
