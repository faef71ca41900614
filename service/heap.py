"""Make the C library return large freed blocks to the system at once.

By default glibc raises its mmap threshold when a large block is freed. After an image of 30 MiB it takes the next one from an arena.
There are up to eight arenas per core, and glibc never returns the free memory at their ends.
After a flood of requests a service of 200 MiB held 2.5 GiB.
"""

import ctypes
import threading

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8
#: glibc takes blocks of ``MAPPED_BYTES`` or more directly from the system. An arena keeps at most ``KEPT_BYTES`` free at its end.
#: Lower values cost time, because every image then needs new pages (decision log).
MAPPED_BYTES, KEPT_BYTES = 16 * 2**20, 32 * 2**20
#: A release of this size or more triggers a trim.
LARGE_BYTES = 8 * 2**20
#: Delay of a trim. A trim takes milliseconds, so one trim covers many releases.
_TRIM_AFTER_S = 0.25


def limit_heap(threads: int, *, mapped_bytes: int = MAPPED_BYTES) -> None:
    """Limit the free memory that glibc keeps, in this process and its forks; do nothing without glibc.

    Args:
        threads: number of threads that work in parallel; it limits the number of arenas.
        mapped_bytes: blocks of this size or more go back to the system as soon as they are free.
    """
    libc = ctypes.CDLL(None)
    if not hasattr(libc, "mallopt"):
        return
    libc.mallopt(_M_MMAP_THRESHOLD, mapped_bytes)
    libc.mallopt(_M_TRIM_THRESHOLD, KEPT_BYTES)
    libc.mallopt(_M_ARENA_MAX, threads + 2)


def trim() -> None:
    """Return all free memory to the system, also between used blocks; do nothing without glibc. It takes milliseconds.

    A stage that frees many small blocks calls it before a stage that takes large ones.
    """
    release = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if release is not None:
        release(0)


class Trimmer:
    """Returns free memory between used blocks to the system. A large gRPC message leaves thousands of small free blocks."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._is_coming = False

    def soon(self) -> None:
        """Schedule a trim. Calls before it runs share the same trim."""
        with self._lock:
            if self._is_coming:
                return
            self._is_coming = True
        timer = threading.Timer(_TRIM_AFTER_S, self._now)
        timer.daemon = True
        try:
            timer.start()
        except RuntimeError:  # no thread available, or the interpreter ends; the next release schedules a trim again
            with self._lock:
                self._is_coming = False

    def _now(self) -> None:
        with self._lock:
            self._is_coming = False
        trim()
