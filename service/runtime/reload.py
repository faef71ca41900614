"""Reload files that an operator changed while the service runs, such as rotated keys and certificates."""

import logging
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from service.errors import StreetfixError
from service.runtime.wakeup import Wakeup

_log = logging.getLogger("streetfix.reload")

#: State of the files: inode, size, mtime and ctime of each, or None if it is missing. The ctime reveals changed permissions and mounted
#: links.
Signature = tuple[tuple[int, int, int, int] | None, ...]


@dataclass(slots=True)
class _Watched:
    name: str
    paths: tuple[Path, ...]
    load: Callable[[], None]
    seen: Signature = field(default=())


class Reloader:
    """Checks files periodically and on request. If a new file is not usable, it logs the error and the old state stays in force."""

    def __init__(self) -> None:
        self._watched: list[_Watched] = []
        self._wake = Wakeup()
        self._stopping = False
        self._thread: threading.Thread | None = None

    def watch(self, name: str, paths: Sequence[Path], load: Callable[[], None]) -> None:
        """Load files now, and again when one of them changes.

        Args:
            name: for the log.
            paths: of the files; links are followed.
            load: reads all files and applies them, or raises and changes nothing.

        Raises:
            StreetfixError: the files cannot be used now.
        """
        seen = _signature(paths)  # taken before reading, so the next check sees a change during the reading
        load()
        self._watched.append(_Watched(name, tuple(paths), load, seen))

    def look(self, *, everything: bool = False) -> None:
        """Load the files that have changed since the last check.

        Args:
            everything: load unchanged files too.
        """
        for each in self._watched:
            now = _signature(each.paths)
            if now == each.seen and not everything:
                continue
            each.seen = now
            try:
                each.load()
            except StreetfixError as error:
                _log.error("reload_failed name=%s; the old stays in force: %s", each.name, error.message)
            except Exception:  # the thread must continue: the next change may be valid
                _log.exception("reload_failed name=%s; the old stays in force", each.name)
            else:
                _log.warning("reloaded name=%s", each.name)

    def start(self, every_s: float) -> None:
        """Start a thread that checks the files.

        Args:
            every_s: seconds between two checks; 0 checks only on request.
        """
        self._thread = threading.Thread(target=self._run, args=(every_s or None,), name="streetfix-reload", daemon=True)
        self._thread.start()

    def look_now(self) -> None:
        """Request that the thread loads all files again. Safe to call from a signal handler."""
        self._wake.set()

    def stop(self) -> None:
        """End the thread."""
        self._stopping = True
        self._wake.set()
        if self._thread is not None:
            self._thread.join()

    def _run(self, every_s: float | None) -> None:
        while True:
            signalled = self._wake.wait(every_s)
            if self._stopping:
                return
            if signalled:  # a signal after the timeout of the wait belongs to the next check
                self._wake.clear()
            self.look(everything=signalled)


def _signature(paths: Sequence[Path]) -> Signature:
    return tuple(_state(path) for path in paths)


def _state(path: Path) -> tuple[int, int, int, int] | None:
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_ino, found.st_size, found.st_mtime_ns, found.st_ctime_ns
