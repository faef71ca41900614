"""Reload keys and certificates while the service runs, periodically and on request."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from service.runtime.reload import Reloader

if TYPE_CHECKING:
    from service.cli.certificates import Certificates
    from service.runtime.keys import KeyRing


@contextmanager
def reloading(keys: "KeyRing | None", tls: "Certificates | None", *, every_s: float) -> Iterator[Reloader]:
    """Reload changed files inside the context.

    Args:
        keys: watched if they come from a file; None for no keys.
        tls: certificates to watch; None for no TLS.
        every_s: seconds between two checks; 0 checks only on request.

    Raises:
        KeysError: the files have become unusable since they were read.
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
