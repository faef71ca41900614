"""On which machines the service runs. It needs ``fcntl`` and POSIX signals, and its C code assumes 64 bits, little endian."""

import platform
import sys

from service.errors import UnsupportedPlatformError

#: ``sys.platform`` and ``platform.machine()`` for which the packages that the service needs have wheels.
SUPPORTED = (("linux", "x86_64"), ("linux", "aarch64"), ("darwin", "arm64"))


def require_supported() -> None:
    """Return where the service runs on this machine.

    Raises:
        UnsupportedPlatformError: it does not; the message says where it does.
    """
    machine = platform.machine()
    if (sys.platform, machine) not in SUPPORTED:
        raise UnsupportedPlatformError(
            f"Streetfix does not run on {sys.platform} ({machine}): it runs on Linux (x86-64, 64-bit ARM) and on macOS "
            "(Apple silicon); on Windows use WSL 2 or the container"
        )
