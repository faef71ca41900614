"""Loads the libraries that the build compiled from the C files beside their Python modules."""

import ctypes
from pathlib import Path

from service.errors import StreetfixError


def load(path: Path) -> ctypes.CDLL:
    """The library; its functions run without Python's lock.

    Raises:
        StreetfixError: it was not compiled.
    """
    if not path.exists():
        raise StreetfixError(
            f"{path.name} is missing beside its source in {path.parent}: install the package again (pip install .)"
        )
    return ctypes.CDLL(str(path))
