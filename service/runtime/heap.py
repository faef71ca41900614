"""Makes the C library give large blocks back to the system as soon as they are freed.

By default glibc learns from a freed picture of 30 MiB to take the next one from an arena, each of up to eight for every core keeps what
is freed at its end, and nothing ever takes that back: after a flood a service of 200 MiB held 2.5 GiB.
"""

import ctypes
import threading

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8
#: Blocks of this size are the system's own pages; an arena keeps no more than that at its end. Lower ones cost time, since pages are
#: fetched anew for every picture (decision log).
MAPPED_BYTES, KEPT_BYTES = 16 * 2**20, 32 * 2**20
#: What is freed at once and worth a trim.
LARGE_BYTES = 8 * 2**20
#: Trimming takes milliseconds, so it is done for many releases at once.
_TRIM_AFTER_S = 0.25


def keep_little(threads: int) -> None:
    """Set it for this process and those forked from it; without glibc nothing happens.

    Args:
        threads: that work at once.
    """
    libc = ctypes.CDLL(None)
    if not hasattr(libc, "mallopt"):
        return
    libc.mallopt(_M_MMAP_THRESHOLD, MAPPED_BYTES)
    libc.mallopt(_M_TRIM_THRESHOLD, KEPT_BYTES)
    libc.mallopt(_M_ARENA_MAX, threads + 2)


class Trimmer:
    """Gives the system what lies free between used blocks: a large gRPC message leaves thousands of small ones."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._is_coming = False
        self._trim = getattr(ctypes.CDLL(None), "malloc_trim", None)

    def soon(self) -> None:
        """Trim in a moment, once for all who ask until then."""
        with self._lock:
            if self._is_coming or self._trim is None:
                return
            self._is_coming = True
        timer = threading.Timer(_TRIM_AFTER_S, self._now)
        timer.daemon = True
        try:
            timer.start()
        except RuntimeError:  # no thread can be started now, or the interpreter ends: the next release asks again
            with self._lock:
                self._is_coming = False

    def _now(self) -> None:
        with self._lock:
            self._is_coming = False
        if self._trim is not None:
            self._trim(0)
