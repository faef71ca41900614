"""The console script ``streetfix``. Without the extra ``server`` it prints one line instead of a traceback."""

import sys

from service.cli.extras import EXTRA_OF_PACKAGE, package_of
from service.errors import how_to_install

#: Exit code of a program that SIGINT ended (128 + 2).
INTERRUPTED = 130


def main() -> None:
    """Run the command line of the process and exit, with the exit codes of ``service.cli.main``.

    A package that the command line always needs may be missing, because a plain installation is the client alone. Then the exit
    code is 1. Ctrl-C before the command begins, while its modules are imported, ends with exit code 130 and without a traceback.
    """
    try:
        _main()
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)


def _main() -> None:
    try:
        from service.cli.main import main as run
    except ModuleNotFoundError as error:
        if EXTRA_OF_PACKAGE.get(package_of(error)) != "server":
            raise
        sys.exit(
            f"streetfix: the command line needs the package {package_of(error)!r}, which an installation of only the "
            f"client does not have: {how_to_install('server')}"
        )
    run()
