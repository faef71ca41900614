"""Remove lens distortion on import, so that every image of a dataset is a pinhole image."""

from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import UInt8
from numpy.typing import NDArray

from model_training.importing.recording import Depth, RecordedPicture
from service.geometry.camera import PinholeCamera


@dataclass(frozen=True, slots=True)
class _Maps:
    """Pixel of the recorded image for each pixel of the rectified image."""

    u: NDArray[np.float32]
    v: NDArray[np.float32]


def rectified(picture: RecordedPicture) -> RecordedPicture:
    """Rectify an image pair with OpenCV's distortion models; the camera matrix stays the same.

    Colour is interpolated. Depth takes the nearest value, because a mean of two surfaces is no surface.

    Args:
        picture: recorded image pair.

    Returns:
        The image pair without distortion; the same object if it has none.
    """
    camera = picture.camera
    if not camera.is_distorted:
        return picture
    maps = _maps(camera)
    depth = None if picture.depth is None else _nearest(picture.depth, maps)
    return replace(
        picture,
        rgb=_smooth(picture.rgb, maps),
        depth=depth,
        camera=replace(camera, distortion=(), distortion_model="brown_conrady"),
        file=None,
    )


@lru_cache(maxsize=8)
def _maps(camera: PinholeCamera) -> _Maps:
    is_fisheye = camera.distortion_model == "kannala_brandt"
    rectify = cv2.fisheye.initUndistortRectifyMap if is_fisheye else cv2.initUndistortRectifyMap
    u, v = rectify(
        camera.matrix,
        np.array(camera.distortion),
        np.eye(3),
        camera.matrix,
        (camera.width, camera.height),
        cv2.CV_32FC1,
    )
    return _Maps(np.asarray(u, np.float32), np.asarray(v, np.float32))


def _smooth(rgb: UInt8[NDArray[np.uint8], "H W 3"], maps: _Maps) -> UInt8[NDArray[np.uint8], "H W 3"]:
    return np.asarray(cv2.remap(rgb, maps.u, maps.v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT), np.uint8)


def _nearest(depth: Depth, maps: _Maps) -> Depth:
    moved = cv2.remap(depth, maps.u, maps.v, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT)
    return np.asarray(moved, np.uint16) if depth.dtype == np.uint16 else np.asarray(moved, np.float32)
