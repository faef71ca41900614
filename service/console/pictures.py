"""Images of depth and views for the console."""

import cv2
import numpy as np
from jaxtyping import Float32, UInt8
from numpy.typing import NDArray

from service.imaging.view_grid import MAX_RANGE_M

Drawn = UInt8[NDArray[np.uint8], "H W 3"]


def png_of(rgb: Drawn) -> bytes:
    """Return an image as PNG, with fast compression because it is viewed once.

    Args:
        rgb: the image.
    """
    bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
    return cv2.imencode(".png", bgr, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()


def depth_picture(depth_m: Float32[NDArray[np.float32], "H W"]) -> Drawn:
    """Return a depth image in the Turbo colour map on a square-root scale: near red, far blue, black without a measurement.

    All images have the same scale, so that two can be compared. Depths beyond ``MAX_RANGE_M`` get its colour, so that
    differences of near depths stay visible.

    Args:
        depth_m: depth, m; 0 without a measurement.
    """
    nearness = 1.0 - np.sqrt(np.clip(depth_m / MAX_RANGE_M, 0, 1))
    coloured = cv2.applyColorMap(np.rint(255 * nearness).astype(np.uint8), cv2.COLORMAP_TURBO)
    coloured[depth_m <= 0] = 0
    return np.ascontiguousarray(coloured[..., ::-1])


def enlarged(picture: Drawn, times: int) -> Drawn:
    """Return an image with each pixel repeated, so that the cells of a view are visible.

    Args:
        picture: the image.
        times: factor of both sides.
    """
    return np.repeat(np.repeat(picture, times, axis=0), times, axis=1)
