"""Images inside the page: small copies as data URIs."""

import base64

import cv2
import numpy as np
from numpy.typing import NDArray

from service.imaging.view_grid import MAX_RANGE_M

#: Width of the images that stand side by side, pixels.
WIDTH = 320
_JPEG, _WEBP = [cv2.IMWRITE_JPEG_QUALITY, 72], [cv2.IMWRITE_WEBP_QUALITY, 80]


def colour_uri(rgb: NDArray[np.uint8], *, width: int = WIDTH) -> str:
    """Return a smaller colour image as a data URI.

    Args:
        rgb: colours (H, W, 3).
        width: width of the result, pixels.
    """
    small = cv2.resize(rgb, (width, round(rgb.shape[0] * width / rgb.shape[1])), interpolation=cv2.INTER_AREA)
    return uri("jpeg", cv2.imencode(".jpg", cv2.cvtColor(small, cv2.COLOR_RGB2BGR), _JPEG)[1].tobytes())


def depth_uri(depth_m: NDArray[np.float32], *, width: int = WIDTH) -> str:
    """Return a coloured depth image as a data URI: near is yellow, far is dark blue, no measurement is grey.

    Args:
        depth_m: depth (H, W), metres.
        width: width of the result, pixels.
    """
    return uri("jpeg", cv2.imencode(".jpg", depth_bgr(depth_m, width=width), _JPEG)[1].tobytes())


def depth_bgr(depth_m: NDArray[np.float32], *, width: int) -> NDArray[np.uint8]:
    """Colour a depth image by the logarithm of depth; return BGR (h, width, 3). ``MAX_RANGE_M`` has the darkest colour.

    Args:
        depth_m: depth (H, W), metres.
        width: width of the result, pixels.
    """
    small = cv2.resize(
        depth_m, (width, round(depth_m.shape[0] * width / depth_m.shape[1])), interpolation=cv2.INTER_NEAREST
    )
    measured = np.isfinite(small) & (small > 0)
    near = 1 - np.log(np.clip(np.where(measured, small, 1.0), 1.0, MAX_RANGE_M)) / np.log(MAX_RANGE_M)
    picture = np.asarray(cv2.applyColorMap((30 + 225 * near).astype(np.uint8), cv2.COLORMAP_VIRIDIS), np.uint8)
    picture[~measured] = (128, 128, 128)
    return picture


def grey_webp_uri(alpha: NDArray[np.uint8]) -> str:
    """Return a grey image as a data URI; its opacity shows on light and dark pages.

    Args:
        alpha: opacity (H, W).
    """
    grey = np.full((*alpha.shape, 4), 128, np.uint8)
    grey[..., 3] = alpha
    return uri("webp", cv2.imencode(".webp", grey, _WEBP)[1].tobytes())


def uri(kind: str, data: bytes) -> str:
    """Return ``data:image/KIND`` of encoded bytes.

    Args:
        kind: format of the image.
        data: encoded image.
    """
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"
