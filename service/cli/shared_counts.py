"""Room on the disk for what a worker counts, taken before it counts.

Prometheus' client library keeps the counts of several processes in memory-mapped sparse files. A store into a page for which the disk has
no block left ends the process with SIGBUS. So a full disk would end every worker at its next new count, and again after every
restart.
"""

import os
from pathlib import Path

#: Of each file: three times what the counts of all methods and codes take; each map adds 2.5 KiB.
RESERVED_BYTES = 256 * 2**10
#: Kinds of our metrics, as the library names its files.
_KINDS = ("counter", "histogram", "gauge_livesum")


def reserve(folder: Path) -> OSError | None:
    """Write the files of this process full of zeros, which the library takes for files without a count.

    Args:
        folder: that all workers share.

    Returns:
        Why there is no room; then no file is left. None if all are there.
    """
    paths = [folder / f"{kind}_{os.getpid()}.db" for kind in _KINDS]
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
