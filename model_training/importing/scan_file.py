"""A scan in KITTI's layout: rows of four float32, x y z and intensity."""

from pathlib import Path

import numpy as np
from jaxtyping import Float32
from numpy.typing import NDArray

ROW_BYTES = 16


def read_scan(path: Path, *, max_points: int = 5_000_000) -> Float32[NDArray[np.float32], "N 4"] | str:
    """Points of a scan, or why the file is none; its size is looked at before it is read.

    Args:
        path: of the file.
        max_points: more is refused.
    """
    size = path.stat().st_size
    if size == 0:
        return "the file is empty"
    if size % ROW_BYTES:
        return "its bytes are no rows of four float32: truncated"
    if size > max_points * ROW_BYTES:
        return f"more than {max_points} points"
    return np.fromfile(path, np.float32).reshape(-1, 4)
