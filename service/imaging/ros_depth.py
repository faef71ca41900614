"""Read depth as ROS compressed_depth_image_transport publishes it: a header of 12 bytes, then PNG or RVL.

16UC1 is stored unchanged. 32FC1 is stored as inverse depth. The header holds A and B, and depth = A / (value - B) in metres.

RVL stores differences of neighbouring pixels with variable lengths. NumPy cannot decode such data side by side, so C code does it. The row
``decode.depth.ros_rvl.cpu_ms`` of the reports has its time.
"""

import ctypes
import struct
from typing import Any

import numpy as np
from jaxtyping import Shaped
from numpy.typing import NDArray

from service.imaging.depth16 import library
from service.imaging.picture_headers import ImageLimits, damaged, header_of, require_pixels
from service.imaging.png16 import is_plain_grey16, read_grey16

_HEADER = struct.Struct("<iff")
_SIZE = struct.Struct("<ii")
_PNG = b"\x89PNG"


def read_ros_depth(data: bytes, limits: ImageLimits, *, field: str) -> Shaped[NDArray[Any], "H W"]:
    """Read the data of a ROS compressedDepth message.

    Args:
        data: bytes of the field ``data`` of the message.
        limits: largest number of pixels.
        field: part of the request that errors name.

    Returns:
        uint16 values of the camera (16UC1), or float32 metres with 0 for "not measured" (32FC1).

    Raises:
        DecodeError: the data are damaged, or neither PNG nor RVL.
        TooLargeError: the image has more pixels than the limits allow.
    """
    if len(data) <= _HEADER.size:
        raise damaged(field, "the compressedDepth header is cut off")
    _, a, b = _HEADER.unpack_from(data)
    body = data[_HEADER.size :]
    values = _png(body, limits, field) if body.startswith(_PNG) else _rvl(body, limits, field)
    if a == 0 and b == 0:
        return values
    if not (np.isfinite(a) and np.isfinite(b)):
        raise damaged(field, f"the compressedDepth header states depth = {a} / (value - {b}), which is not finite")
    with np.errstate(all="ignore"):
        depth = np.float32(a) / (values.astype(np.float32) - np.float32(b))
    return np.where(values > 0, depth, np.float32(0)).astype(np.float32)


def _png(body: bytes, limits: ImageLimits, field: str) -> NDArray[np.uint16]:
    header = header_of(body, "PNG", field=field)
    require_pixels(header.height, header.width, limits, field=field)
    if not is_plain_grey16(body):
        raise damaged(field, "the compressedDepth PNG is not 16-bit grey")
    return read_grey16(body, header.height, header.width, field=field)


def _rvl(body: bytes, limits: ImageLimits, field: str) -> NDArray[np.uint16]:
    if len(body) < _SIZE.size:
        raise damaged(field, "the RVL size is cut off")
    width, height = _SIZE.unpack_from(body)
    if width < 1 or height < 1:
        raise damaged(field, f"the RVL size is {width}x{height} pixels (send compressedDepth with png or rvl)")
    require_pixels(height, width, limits, field=field)
    packed, out = body[_SIZE.size :], np.empty((height, width), np.uint16)
    buffer = (ctypes.c_char * len(packed)).from_buffer_copy(packed) if packed else None
    done = library().streetfix_rvl(buffer, len(packed), out.size, out.ctypes.data)
    if done != out.size:
        raise damaged(field, f"the RVL data are cut off or invalid after {done} of {out.size} pixels")
    return out
