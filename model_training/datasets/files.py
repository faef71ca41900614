"""Files of recordings and datasets, which lie on disks that fill up, fail and are unplugged while a command reads them."""

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

ROW_BYTES = 16  # of a scan: x, y, z and intensity, float32

T = TypeVar("T")


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """What the operating system says of a file, said of that file.

    Raises:
        DatasetError: the file vanished, or cannot be read.
    """
    try:
        yield
    except OSError as error:
        raise unreadable(path, error) from error


def unreadable(path: Path, error: OSError) -> DatasetError:
    """The error for a file that vanished or cannot be read."""
    if isinstance(error, FileNotFoundError):
        what = "it is missing, or vanished while it was wanted; bring it back, leave the folder as it is meanwhile, and start again"
    else:
        what = f"it cannot be read ({error.strerror or type(error).__name__}); check its permissions and the disk, and start again"
    return DatasetError(f"{path}: {what}", field=path.name)


def read_bytes(path: Path) -> bytes:
    """The content of a file.

    Raises:
        DatasetError: it vanished, or cannot be read.
    """
    with reading(path):
        return path.read_bytes()


def size_of(path: Path) -> int:
    """Bytes of a file.

    Raises:
        DatasetError: it vanished, or cannot be looked at.
    """
    with reading(path):
        return path.stat().st_size


def read_rows(path: Path, size: int) -> Float32[NDArray[np.float32], "N 4"]:
    """Rows of a scan whose size is known.

    Raises:
        DatasetError: it vanished, cannot be read, or became shorter.
    """
    with reading(path):
        values = np.fromfile(path, np.float32, count=size // 4)
    if len(values) != size // 4:
        raise DatasetError(
            f"{path}: it had {size} bytes and then {4 * len(values)}: something writes it while it is read; leave the folder as it is "
            "meanwhile, and start again", field=path.name,
        )  # fmt: skip
    return values.reshape(-1, 4)


def read_arrays(path: Path, read: Callable[[], T], *, remedy: str) -> T:
    """What NumPy reads of a ``.npy`` or ``.npz`` file.

    Args:
        path: that ``read`` reads.
        read: gives the arrays.
        remedy: for a file that is damaged.

    Raises:
        DatasetError: the file vanished, cannot be read or is damaged, as one that was written in part.
    """
    with reading(path):
        try:
            return read()
        except (KeyError, BadZipFile, *NPY_HEADER_ERRORS) as error:
            raise DatasetError(f"{path}: it is damaged ({error}); {remedy}", field=path.name) from error
