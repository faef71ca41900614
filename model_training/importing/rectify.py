"""Lens distortion taken out on import, so that every picture of a dataset is a pinhole's."""

from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import UInt8
from numpy.typing import NDArray

from model_training.importing.recording import Depth, Lens, RecordedPicture
from service.geometry.camera import PinholeCamera


@dataclass(frozen=True, slots=True)
class _Maps:
    """Where each pixel of the rectified picture lies in the recorded one."""

    u: NDArray[np.float32]
    v: NDArray[np.float32]


def rectified(picture: RecordedPicture) -> RecordedPicture:
    """The same picture pair as a pinhole with the same matrix would have taken it (OpenCV's distortion models).

    Colour is interpolated; depth takes the nearest value, since between two surfaces there is none.
    """
    camera = picture.camera
    if not any(camera.distortion):
        return picture
    maps = _maps(camera, picture.lens)
    depth = None if picture.depth is None else _nearest(picture.depth, maps)
    return replace(
        picture, rgb=_smooth(picture.rgb, maps), depth=depth, camera=replace(camera, distortion=()), file=None
    )


@lru_cache(maxsize=8)
def _maps(camera: PinholeCamera, lens: Lens) -> _Maps:
    rectify = cv2.fisheye.initUndistortRectifyMap if lens == "fisheye" else cv2.initUndistortRectifyMap
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
