"""Log lines about a fetch from object storage: when it begins, while data arrives, and when all files are there and whole.

A service that fetches a map at its start shows nothing else.
"""

import logging
import threading
import time
from collections.abc import Callable
from types import TracebackType

#: Least time between two lines about the same fetch, s.
REPORT_EVERY_S = 10.0
_MB = 1_000_000
_log = logging.getLogger("streetfix.maps")


class FetchLog:
    """Counts and logs the bytes of one fetch (``service.maps.store.stored_map.Follow``). Threads may share it.

    The lines about a map have the level WARNING, as those about mounted maps, and those about a tile have the level INFO.

    Args:
        kind: "map" or "tile". It begins the names of the events, such as ``map_fetching`` and ``map_fetched``.
        url: of what is fetched.
        total: bytes of all files.
        on_fetched: called at the end with the kind, the bytes and the seconds, unless the fetch failed.
    """

    def __init__(
        self,
        kind: str,
        url: str,
        total: int,
        *,
        on_fetched: Callable[[str, int, float], object] = lambda *_: None,
    ) -> None:
        self._kind, self._url, self._total = kind, url, total
        self._on_fetched = on_fetched
        self._level = logging.WARNING if kind == "map" else logging.INFO
        self._done = 0
        self._began_s = self._told_s = time.monotonic()
        self._lock = threading.Lock()

    def __enter__(self) -> Callable[[int], None]:
        """Log the begin; return what counts the bytes of a piece."""
        self._tell()
        return self._add

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Log the end, unless the fetch failed. The caller logs why it failed."""
        if error is None:
            elapsed_s = time.monotonic() - self._began_s
            _log.log(
                self._level, "%s_fetched url=%s mb=%.1f s=%.1f", self._kind, self._url, self._done / _MB, elapsed_s
            )
            self._on_fetched(self._kind, self._done, elapsed_s)

    def _add(self, size: int) -> None:
        with self._lock:
            self._done += size
            now_s = time.monotonic()
            if self._done < self._total and now_s - self._told_s >= REPORT_EVERY_S:
                self._told_s = now_s
                self._tell()

    def _tell(self) -> None:
        _log.log(
            self._level,
            "%s_fetching url=%s mb=%.1f of=%.1f",
            self._kind,
            self._url,
            self._done / _MB,
            self._total / _MB,
        )
