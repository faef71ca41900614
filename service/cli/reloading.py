"""Keys and certificates that are replaced while the service runs: looked at every so often, and when the reloader is told to."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from service.runtime.reload import Reloader

if TYPE_CHECKING:
    from service.cli.certificates import Certificates
    from service.runtime.keys import KeyRing


@contextmanager
def reloading(keys: "KeyRing | None", tls: "Certificates | None", *, every_s: float) -> Iterator[Reloader]:
    """Take over changed files inside.

    Args:
        keys: read from a file.
        tls: read from files.
        every_s: seconds between two looks; 0 looks only when the reloader is told to.

    Raises:
        KeysError: they have become unusable since they were read.
    """
    reloader = Reloader()
    if keys is not None and keys.path is not None:
        reloader.watch("api_keys", (keys.path,), keys.reload)
    if tls is not None:
        reloader.watch("tls", tls.paths, tls.reload)
    reloader.start(every_s)
    try:
        yield reloader
    finally:
        reloader.stop()
