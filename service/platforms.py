"""On which machines the service runs. It needs ``fcntl`` and POSIX signals, and its C code assumes 64 bits, little endian."""

import platform
import sys

from service.errors import UnsupportedPlatformError

#: ``sys.platform`` and ``platform.machine()``; the packages that the service needs have wheels for the same.
SYSTEMS = {"linux": "Linux", "darwin": "macOS"}
MACHINES = ("x86_64", "aarch64", "arm64")


def require_supported() -> None:
    """Return where the service runs on this machine.

    Raises:
        UnsupportedPlatformError: it does not; the message says where it does.
    """
    machine = platform.machine()
    if sys.platform not in SYSTEMS or machine not in MACHINES:
        raise UnsupportedPlatformError(
            f"Streetfix does not run on {sys.platform} ({machine}): it runs on Linux and macOS, on x86-64 and 64-bit ARM; "
            "on Windows use WSL 2 or the container"
        )
