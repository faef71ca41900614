"""Log lines about a fetch from object storage: one when it begins, one every few seconds, and one at the end.

A service that fetches a map at its start shows nothing else.
"""

import logging
import threading
import time

#: Time between two lines about the same fetch, s.
REPORT_EVERY_S = 10.0
_MB = 1_000_000
_log = logging.getLogger("streetfix.maps")


class FetchLog:
    """Counts and logs the bytes of one fetch (``service.maps.store.stored_map.Follow``). Threads may share it.

    Args:
        kind: "map" or "tile". It begins the names of the events, such as ``map_fetching`` and ``map_fetched``.
        url: of what is fetched.
        total: bytes of all files.
    """

    def __init__(self, kind: str, url: str, total: int) -> None:
        self._kind, self._url, self._total = kind, url, total
        self._done = 0
        self._began_s = self._told_s = time.monotonic()
        self._lock = threading.Lock()
        self._tell()

    def __call__(self, size: int) -> None:
        """Count a piece.

        Args:
            size: bytes.
        """
        with self._lock:
            self._done += size
            now_s = time.monotonic()
            if self._done == self._total:
                _log.info(
                    "%s_fetched url=%s mb=%.1f s=%.1f", self._kind, self._url, self._done / _MB, now_s - self._began_s
                )
            elif now_s - self._told_s >= REPORT_EVERY_S:
                self._told_s = now_s
                self._tell()

    def _tell(self) -> None:
        _log.info("%s_fetching url=%s mb=%.1f of=%.1f", self._kind, self._url, self._done / _MB, self._total / _MB)
