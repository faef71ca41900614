"""Read a scan in KITTI's layout: rows of four float32, x y z and intensity."""

from pathlib import Path

import numpy as np
from jaxtyping import Float32
from numpy.typing import NDArray

from model_training.datasets.files import ROW_BYTES, read_rows, size_of


def read_scan(path: Path, *, max_points: int = 5_000_000) -> Float32[NDArray[np.float32], "N 4"] | str:
    """Read the points of a scan, or say why the file is none. The size is checked before the file is read.

    Args:
        path: of the file.
        max_points: a larger scan is refused.

    Returns:
        x y z and intensity (N, 4); or the reason.

    Raises:
        DatasetError: the file is missing or cannot be read. A file that the recording names must not be skipped silently.
    """
    size = size_of(path)
    if size == 0:
        return "the file is empty"
    if size % ROW_BYTES:
        return "its size is not a multiple of 16 bytes (rows of four float32): truncated"
    if size > max_points * ROW_BYTES:
        return f"more than {max_points} points"
    return read_rows(path, size)
