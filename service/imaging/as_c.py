"""A picture's size and intrinsics as the compiled code reads them."""

from ctypes import Structure, c_double, c_int64
from typing import Any

from numpy.typing import NDArray

from service.geometry.camera import PinholeCamera


class CPicture(Structure):
    """``Picture`` of ``picture.h``."""

    _fields_ = [("height", c_int64), ("width", c_int64), *((name, c_double) for name in ("fx", "fy", "cx", "cy"))]


def c_picture(camera: PinholeCamera, picture: NDArray[Any]) -> CPicture:
    """Of a picture of a camera, at any scale."""
    height, width = picture.shape[:2]
    own = camera if (camera.height, camera.width) == (height, width) else camera.scaled_to(width, height)
    return CPicture(height, width, own.fx, own.fy, own.cx, own.cy)
