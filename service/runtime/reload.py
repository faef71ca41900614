"""Takes over files that an operator changed, such as rotated keys and certificates, while the service runs."""

import logging
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from service.errors import StreetfixError
from service.runtime.wakeup import Wakeup

_log = logging.getLogger("streetfix.reload")

#: What tells one state of a file from another; its time of change covers permissions and mounted links.
Signature = tuple[tuple[int, int, int, int] | None, ...]


@dataclass(slots=True)
class _Watched:
    name: str
    paths: tuple[Path, ...]
    load: Callable[[], None]
    seen: Signature = field(default=())


class Reloader:
    """Looks at files every so often, and at once when it is told to; what cannot be used is logged, and the old stays in force."""

    def __init__(self) -> None:
        self._watched: list[_Watched] = []
        self._wake = Wakeup()
        self._stopping = False
        self._thread: threading.Thread | None = None

    def watch(self, name: str, paths: Sequence[Path], load: Callable[[], None]) -> None:
        """Load files now, and again when one of them changes.

        Args:
            name: for the log.
            paths: of the files; a link counts as what it leads to.
            load: reads all of them and takes them over, or raises and changes nothing.

        Raises:
            StreetfixError: they cannot be used now.
        """
        seen = _signature(paths)  # before they are read: what changes meanwhile is seen at the next look
        load()
        self._watched.append(_Watched(name, tuple(paths), load, seen))

    def look(self, *, everything: bool = False) -> None:
        """Load what has changed since the last look.

        Args:
            everything: load what has not changed, too.
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
            except Exception:  # a thread of ours must go on: the next change may be good again
                _log.exception("reload_failed name=%s; the old stays in force", each.name)
            else:
                _log.warning("reloaded name=%s", each.name)

    def start(self, every_s: float) -> None:
        """Look from now on, in a thread.

        Args:
            every_s: seconds between two looks; 0 for never, only when told.
        """
        self._thread = threading.Thread(target=self._run, args=(every_s or None,), name="streetfix-reload", daemon=True)
        self._thread.start()

    def look_now(self) -> None:
        """Load everything again, soon; safe to call from a signal handler."""
        self._wake.set()

    def stop(self) -> None:
        """End the thread."""
        self._stopping = True
        self._wake.set()
        if self._thread is not None:
            self._thread.join()

    def _run(self, every_s: float | None) -> None:
        while True:
            told = self._wake.wait(every_s)
            if self._stopping:
                return
            if told:  # a signal that comes after the wait has timed out is for the next look
                self._wake.clear()
            self.look(everything=told)


def _signature(paths: Sequence[Path]) -> Signature:
    return tuple(_state(path) for path in paths)


def _state(path: Path) -> tuple[int, int, int, int] | None:
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_ino, found.st_size, found.st_mtime_ns, found.st_ctime_ns
