"""Size and intrinsics of an image in the layout that the compiled code reads."""

from ctypes import Structure, c_double, c_int64
from typing import Any

from numpy.typing import NDArray

from service.geometry.camera import PinholeCamera


class CPicture(Structure):
    """Mirror of the struct ``Picture`` in ``picture.h``."""

    _fields_ = [("height", c_int64), ("width", c_int64), *((name, c_double) for name in ("fx", "fy", "cx", "cy"))]


def c_picture(camera: PinholeCamera, picture: NDArray[Any]) -> CPicture:
    """Pack the size of an image and the intrinsics of its camera for the compiled code.

    Args:
        camera: camera of the image, pixels. If its size differs, its intrinsics are scaled to the size of the image.
        picture: image, (H, W) or (H, W, C). The function reads only its shape.
    """
    height, width = picture.shape[:2]
    own = camera if (camera.height, camera.width) == (height, width) else camera.scaled_to(width, height)
    return CPicture(height, width, own.fx, own.fy, own.cx, own.cy)
