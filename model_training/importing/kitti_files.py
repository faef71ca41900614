"""Read and check the files of a frame in KITTI's object layout."""

from pathlib import Path

import numpy as np
from jaxtyping import UInt8, UInt16
from numpy.typing import NDArray

from model_training.datasets.files import ROW_BYTES, read_bytes, read_rows, size_of
from service.errors import DatasetError, StreetfixError
from service.imaging.decode import ImageLimits, decode_rgb
from service.imaging.depth_formats import read_depth_values

_LIMITS = ImageLimits()


def copy_scan(path: Path, to: Path) -> None:
    """Copy a scan (float32 x y z intensity) after a check.

    Args:
        path: of the scan.
        to: file to write.

    Raises:
        DatasetError: the scan is empty or cut off, or a number in it is not finite.
    """
    size = size_of(path)
    if size == 0 or size % ROW_BYTES:
        raise damaged(path, f"{size} bytes are not a multiple of 16 (rows of four float32)")
    points = read_rows(path, size)
    if not np.isfinite(points).all():
        raise damaged(path, "a coordinate is not finite")
    to.parent.mkdir(parents=True, exist_ok=True)
    points.tofile(to)


def read_rgb(path: Path) -> UInt8[NDArray[np.uint8], "H W 3"]:
    """Read a colour image.

    Args:
        path: of the image.

    Raises:
        DatasetError: it is damaged.
    """
    try:
        return decode_rgb(read_bytes(path), limits=_LIMITS)
    except StreetfixError as error:
        raise damaged(path, str(error)) from error


def read_stored_depth(path: Path, size: tuple[int, ...]) -> UInt16[NDArray[np.uint16], "H W"]:
    """Read the depth stored beside an image: metres x 256, 0 where nothing was measured.

    Args:
        path: 16-bit PNG.
        size: (height, width) of the left image.

    Raises:
        DatasetError: it is missing or damaged, or has another size.
    """
    if not path.is_file():
        raise damaged(path, "the stored depth of this frame is missing (--depth sgbm needs none)")
    try:
        values = read_depth_values(read_bytes(path), encoding=None, limits=_LIMITS)
    except StreetfixError as error:
        raise damaged(path, str(error)) from error
    if values.dtype != np.uint16 or values.shape != size:
        raise damaged(path, f"its size is {values.shape} of {values.dtype}, but the left image has {size}")
    return values.astype(np.uint16, copy=False)


def damaged(path: Path, why: str) -> DatasetError:
    """Make the error for a file of a recording that cannot be used.

    Args:
        path: of the file.
        why: the reason.
    """
    return DatasetError(f"{path}: {why}; copy the file from the recording again, or remove the frame", field=path.name)
