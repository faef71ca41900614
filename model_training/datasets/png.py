"""Pictures of a dataset as PNG."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray


def write_png(path: Path, values: NDArray[np.uint8] | NDArray[np.uint16]) -> None:
    """Write a picture, its folder too; colour as OpenCV has it, blue first.

    Raises:
        OSError: the disk does not take it, which OpenCV's own ``imwrite`` would not say.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(cv2.imencode(".png", values, [cv2.IMWRITE_PNG_COMPRESSION, 2])[1].tobytes())
