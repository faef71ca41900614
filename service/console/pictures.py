"""What a machine saw, drawn for people."""

import cv2
import numpy as np
from jaxtyping import Float32, UInt8
from numpy.typing import NDArray

Drawn = UInt8[NDArray[np.uint8], "H W 3"]

#: Depths beyond are drawn like this one, so that near differences are seen.
FARTHEST_M = 40.0


def png_of(rgb: Drawn) -> bytes:
    """Encoded, fast rather than small: it is looked at once."""
    bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
    return cv2.imencode(".png", bgr, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()


def depth_picture(depth_m: Float32[NDArray[np.float32], "H W"]) -> Drawn:
    """Depth in Google's Turbo colours, near red, far blue, on a scale of square roots; black where nothing is known.

    The same scale for every picture, so that two can be laid over each other.
    """
    nearness = 1.0 - np.sqrt(np.clip(depth_m / FARTHEST_M, 0, 1))
    coloured = cv2.applyColorMap(np.rint(255 * nearness).astype(np.uint8), cv2.COLORMAP_TURBO)
    coloured[depth_m <= 0] = 0
    return np.ascontiguousarray(coloured[..., ::-1])


def enlarged(picture: Drawn, times: int) -> Drawn:
    """Cells as squares: a view has 32 x 128 of them."""
    return np.repeat(np.repeat(picture, times, axis=0), times, axis=1)
