"""A scan in KITTI's layout: rows of four float32, x y z and intensity."""

from pathlib import Path

import numpy as np
from jaxtyping import Float32
from numpy.typing import NDArray

from model_training.datasets.files import ROW_BYTES, read_rows, size_of


def read_scan(path: Path, *, max_points: int = 5_000_000) -> Float32[NDArray[np.float32], "N 4"] | str:
    """Points of a scan, or why the file is none; its size is looked at before it is read.

    Args:
        path: of the file.
        max_points: more is refused.

    Raises:
        DatasetError: the file vanished, or cannot be read: what is named in a recording is not simply left out.
    """
    size = size_of(path)
    if size == 0:
        return "the file is empty"
    if size % ROW_BYTES:
        return "its bytes are no rows of four float32: truncated"
    if size > max_points * ROW_BYTES:
        return f"more than {max_points} points"
    return read_rows(path, size)
