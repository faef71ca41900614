"""Write images of a dataset as PNG."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray


def write_png(path: Path, values: NDArray[np.uint8] | NDArray[np.uint16]) -> None:
    """Write an image as PNG. Missing parent folders are created.

    Args:
        path: file to write.
        values: image (H, W) or (H, W, 3); colour in OpenCV's order: blue, green, red.

    Raises:
        OSError: the disk refuses the file. OpenCV's own ``imwrite`` does not report this.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(cv2.imencode(".png", values, [cv2.IMWRITE_PNG_COMPRESSION, 2])[1].tobytes())
