"""16-bit grey PNG, a depth camera's own format, in under half of the time that a general decoder takes.

It inflates with libdeflate, at once and into a buffer of the size that the header allows, and takes the filters off in
compiled code; what a PNG may be besides (interlaced, of other samples) is left to OpenCV. Pixels are the same (a test compares them).
"""

import ctypes
import struct

import deflate
import numpy as np
from jaxtyping import UInt16
from numpy.typing import NDArray

from service.imaging.depth16 import library
from service.imaging.picture_headers import damaged

_SIGNATURE_BYTES = 8
_FIRST_CHUNK = struct.Struct(">I4sIIBBBBB")


def is_plain_grey16(data: bytes) -> bool:
    """Whether ``read_grey16`` reads it: 16-bit grey, not interlaced."""
    length, kind, _, _, bits, colour, compression, filters, interlace = _FIRST_CHUNK.unpack_from(data, _SIGNATURE_BYTES)
    return (length, kind, bits, colour, compression, filters, interlace) == (13, b"IHDR", 16, 0, 0, 0, 0)


def read_grey16(data: bytes, height: int, width: int, *, field: str) -> UInt16[NDArray[np.uint16], "H W"]:
    """Pixels of a PNG that ``is_plain_grey16``, whose chunks were seen to end within the data.

    Args:
        data: the file.
        height: as its header says, checked against the limits.
        width: the same.
        field: to name in errors.

    Raises:
        DecodeError: a checksum does not fit, or the pixels are damaged or cut off.
    """
    needed = height * (1 + 2 * width)
    parts: list[memoryview] = []
    view, at = memoryview(data), _SIGNATURE_BYTES
    try:
        while True:
            length, kind = struct.unpack_from(">I4s", data, at)
            end = at + 8 + length
            if deflate.crc32(view[at + 4 : end]) != struct.unpack_from(">I", data, end)[0]:
                raise damaged(field, f"the checksum of its chunk {kind.hex(' ')} does not fit")
            if kind == b"IDAT":
                parts.append(view[at + 8 : end])
            elif kind == b"IEND":
                break
            at = end + 4
        # One byte of room beyond what is needed tells a picture that is too long.
        raw = deflate.zlib_decompress(parts[0] if len(parts) == 1 else b"".join(parts), needed + 1)
    except (deflate.DeflateError, struct.error) as error:
        raise damaged(field, "its pixels are damaged, cut off, or far more than its header says") from error
    if len(raw) != needed:
        raise damaged(field, f"it holds {len(raw)} bytes of pixels where {width}x{height} need {needed}")
    out = np.empty((height, width), np.uint16)
    rows = library().streetfix_unfilter((ctypes.c_char * needed).from_buffer(raw), height, width, out.ctypes.data)
    if rows != height:
        raise damaged(field, f"row {rows} has an unknown filter")
    return out
