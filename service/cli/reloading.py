"""Keys and certificates that are replaced while the service runs: looked at every so often, and on SIGHUP."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import TYPE_CHECKING

from service.runtime.reload import Reloader

if TYPE_CHECKING:
    from service.cli.certificates import Certificates
    from service.runtime.keys import KeyRing


@contextmanager
def reloading(keys: "KeyRing | None", tls: "Certificates | None", *, every_s: float) -> Iterator[None]:
    """Take over changed files inside; enter it after everybody else who handles SIGHUP, whose handler is called first.

    Args:
        keys: read from a file.
        tls: read from files.
        every_s: seconds between two looks; 0 for SIGHUP alone.

    Raises:
        KeysError: they have become unusable since they were read.
    """
    reloader = Reloader()
    if keys is not None and keys.path is not None:
        reloader.watch("api_keys", (keys.path,), keys.reload)
    if tls is not None:
        reloader.watch("tls", tls.paths, tls.reload)
    before = signal.getsignal(signal.SIGHUP) if hasattr(signal, "SIGHUP") else None

    def on_hangup(number: int, frame: FrameType | None) -> None:
        if callable(before):
            before(number, frame)
        reloader.look_now()

    if hasattr(signal, "SIGHUP"):
        signal.signal(signal.SIGHUP, on_hangup)
    reloader.start(every_s)
    try:
        yield
    finally:
        if before is not None:
            signal.signal(signal.SIGHUP, before)
        reloader.stop()
