"""Reserve disk space for the metrics of a worker before it counts.

With several processes the Prometheus client library keeps the counts in memory-mapped sparse files. If the disk has no block left for a
page, a write to it ends the process with SIGBUS. So a full disk would end every worker at its next new count, and again after every
restart.
"""

import os
import struct
from pathlib import Path

#: Size of each file: three times the size of the counts of all methods and codes. Each map adds 2.5 KiB.
RESERVED_BYTES = 256 * 2**10
#: Kinds of metrics in the file names of the library: counts that stay after a process has ended, and values of living processes.
_COUNTS, _LIVE = ("counter", "histogram"), ("gauge_livesum",)
#: A file begins with the number of used bytes, a 4-byte integer in an 8-byte field.
_HEADER_BYTES = 8


def reserve(folder: Path) -> OSError | None:
    """Fill the files of this process with zeros. For the library such files hold no counts.

    Args:
        folder: that all workers share.

    Returns:
        None on success. Else the error; the files are then removed.
    """
    paths = [folder / f"{kind}_{os.getpid()}.db" for kind in (*_COUNTS, *_LIVE)]
    try:
        for path in paths:
            with path.open("ab", buffering=0) as file:  # append: counts of an earlier process with this id stay
                missing = RESERVED_BYTES - file.tell()
                while missing > 0:
                    missing -= file.write(bytes(missing))
    except OSError as error:
        for path in paths:
            path.unlink(missing_ok=True)
        return error
    return None


def release(folder: Path, pid: int) -> None:
    """Release the unused space of a process that has ended. Its counts stay.

    Args:
        folder: that all workers share.
        pid: id of the process.
    """
    for kind in _LIVE:  # values of a living process end with it
        (folder / f"{kind}_{pid}.db").unlink(missing_ok=True)
    for kind in _COUNTS:
        path = folder / f"{kind}_{pid}.db"
        try:
            with path.open("rb") as file:
                (used,) = struct.unpack("i", file.read(4))
        except (FileNotFoundError, struct.error):  # it ended before it wrote the file
            continue
        if used <= _HEADER_BYTES:
            path.unlink(missing_ok=True)
        else:
            os.truncate(path, used)
