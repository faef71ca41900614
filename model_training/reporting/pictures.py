"""Pictures inside the page: small copies as data URIs."""

import base64

import cv2
import numpy as np
from numpy.typing import NDArray

#: Of the pictures that stand beside each other in a row, pixels.
WIDTH = 320
_JPEG, _WEBP = [cv2.IMWRITE_JPEG_QUALITY, 72], [cv2.IMWRITE_WEBP_QUALITY, 80]
#: What is drawn darkest; the view grid forgets what lies beyond it, metres.
FARTHEST_M = 40.0


def colour_uri(rgb: NDArray[np.uint8], *, width: int = WIDTH) -> str:
    """A colour picture (H, W, 3), smaller."""
    small = cv2.resize(rgb, (width, round(rgb.shape[0] * width / rgb.shape[1])), interpolation=cv2.INTER_AREA)
    return uri("jpeg", cv2.imencode(".jpg", cv2.cvtColor(small, cv2.COLOR_RGB2BGR), _JPEG)[1].tobytes())


def depth_uri(depth_m: NDArray[np.float32], *, width: int = WIDTH) -> str:
    """A depth picture (H, W), metres, coloured: near is yellow, far is dark blue, nothing measured is grey."""
    return uri("jpeg", cv2.imencode(".jpg", depth_bgr(depth_m, width=width), _JPEG)[1].tobytes())


def depth_bgr(depth_m: NDArray[np.float32], *, width: int) -> NDArray[np.uint8]:
    """The coloured depth picture (h, width, 3), BGR; depths are spread by their logarithm, as the eye has them."""
    small = cv2.resize(
        depth_m, (width, round(depth_m.shape[0] * width / depth_m.shape[1])), interpolation=cv2.INTER_NEAREST
    )
    measured = np.isfinite(small) & (small > 0)
    near = 1 - np.log(np.clip(np.where(measured, small, 1.0), 1.0, FARTHEST_M)) / np.log(FARTHEST_M)
    picture = np.asarray(cv2.applyColorMap((30 + 225 * near).astype(np.uint8), cv2.COLORMAP_VIRIDIS), np.uint8)
    picture[~measured] = (128, 128, 128)
    return picture


def grey_webp_uri(alpha: NDArray[np.uint8]) -> str:
    """A picture (H, W) of one grey that both light and dark pages show, by its opacity."""
    grey = np.full((*alpha.shape, 4), 128, np.uint8)
    grey[..., 3] = alpha
    return uri("webp", cv2.imencode(".webp", grey, _WEBP)[1].tobytes())


def uri(kind: str, data: bytes) -> str:
    """``data:image/KIND`` of encoded bytes."""
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"
