"""Files of recordings and datasets. A disk may fill up, fail or be unplugged while a command reads them."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar
from zipfile import BadZipFile

import numpy as np
from jaxtyping import Float32
from numpy.typing import NDArray

from service.errors import DatasetError
from service.imaging.npy_header import NPY_HEADER_ERRORS

#: Bytes of one row of a scan: x, y, z and intensity as float32.
ROW_BYTES = 16

#: Result of a function that reads arrays.
T = TypeVar("T")


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Convert errors of the operating system inside the ``with`` block to errors that name the file.

    Args:
        path: file that the block reads.

    Raises:
        DatasetError: the file vanished or cannot be read.
    """
    try:
        yield
    except OSError as error:
        raise unreadable(path, error) from error


def unreadable(path: Path, error: OSError) -> DatasetError:
    """Return the error for a file that vanished or cannot be read.

    Args:
        path: the file.
        error: error of the operating system.
    """
    if isinstance(error, FileNotFoundError):
        what = (
            "the file is missing, or was removed during the run; restore it, do not change the folder meanwhile, and "
            "start again"
        )
    else:
        what = (
            f"the file cannot be read ({error.strerror or type(error).__name__}); check its permissions and the disk, "
            "and start again"
        )
    return DatasetError(f"{path}: {what}", field=path.name)


def read_bytes(path: Path) -> bytes:
    """Return the content of a file.

    Args:
        path: file to read.

    Raises:
        DatasetError: the file vanished or cannot be read.
    """
    with reading(path):
        return path.read_bytes()


def size_of(path: Path) -> int:
    """Return the size of a file, bytes.

    Args:
        path: the file.

    Raises:
        DatasetError: the file vanished or cannot be accessed.
    """
    with reading(path):
        return path.stat().st_size


def read_rows(path: Path, size: int) -> Float32[NDArray[np.float32], "N 4"]:
    """Read the rows of a scan whose size is known: x, y, z (m) and intensity.

    Args:
        path: file of the scan.
        size: size of the file, bytes.

    Raises:
        DatasetError: the file vanished, cannot be read, or became shorter.
    """
    with reading(path):
        values = np.fromfile(path, np.float32, count=size // 4)
    if len(values) != size // 4:
        raise DatasetError(
            f"{path}: the file changed while it was read (from {size} to {4 * len(values)} bytes); "
            "do not change the folder meanwhile, and start again",
            field=path.name,
        )
    return values.reshape(-1, 4)


def read_arrays(path: Path, read: Callable[[], T], *, remedy: str) -> T:
    """Return the arrays that NumPy reads from a ``.npy`` or ``.npz`` file.

    Args:
        path: file that ``read`` reads; errors name it.
        read: function that reads the arrays.
        remedy: advice for a damaged file, part of the error message.

    Raises:
        DatasetError: the file vanished, cannot be read or is damaged, for example only partly written.
    """
    with reading(path):
        try:
            return read()
        except (KeyError, BadZipFile, *NPY_HEADER_ERRORS) as error:
            raise DatasetError(f"{path}: the file is damaged ({error}); {remedy}", field=path.name) from error
