"""Depth pictures as arrays of raw values; what the values mean is said in ``depth_units``.

Every reader checks the size that the header states against the limits before it touches the data.
"""

import io
from typing import Any, Literal

import cv2
import numpy as np
from jaxtyping import Shaped
from numpy.typing import NDArray

from service.errors import UnsupportedFormatError
from service.imaging.npy_header import NPY_HEADER_ERRORS
from service.imaging.picture_headers import ImageLimits, damaged, format_of, header_of, require_bytes, require_pixels
from service.imaging.png16 import is_plain_grey16, read_grey16
from service.imaging.raw16 import read_raw16
from service.imaging.ros_depth import read_ros_depth

#: ``auto`` (as None) tells by the first bytes; ``carla`` is CARLA's depth in the three channels of an 8-bit PNG;
#: ``compressed_depth`` is the data of a ROS message of compressed_depth_image_transport, PNG or RVL.
DepthEncoding = Literal["auto", "carla", "compressed_depth"]
Values = Shaped[NDArray[Any], "H W"]

#: CARLA's far plane: it means "nothing hit", and so no measurement.
CARLA_FAR_VALUE = 2**24 - 1
_MAX_NPY_HEADER_BYTES = 1024
_NPY_DTYPES = frozenset({"f2", "f4", "f8", "u2"})
_FIELD = "depth"


def read_depth_values(data: bytes, *, encoding: DepthEncoding | None, limits: ImageLimits) -> Values:
    """Read the raw values of a depth picture.

    Args:
        data: a 16-bit grey PNG, an 8-bit colour PNG of CARLA's (``encoding="carla"``), a float TIFF, an NPY of float16,
            float32, float64 or uint16, or raw16 (``service.imaging.raw16``).
        encoding: how to read it where the first bytes do not tell, else None.
        limits: what the picture may cost.

    Returns:
        Values as stored; integers are uint16 (CARLA's uint32), the others floating.

    Raises:
        DecodeError: the bytes are not the picture they say they are.
        UnsupportedFormatError: a format, or a sample type, that we do not read as depth.
        TooLargeError: more bytes or pixels than the limits allow.
    """
    require_bytes(data, limits, field=_FIELD)
    if encoding == "compressed_depth":
        return read_ros_depth(data, limits, field=_FIELD)
    format_ = format_of(data, field=_FIELD)
    if encoding == "carla":
        return _carla(data, format_, limits)
    match format_:
        case "PNG":
            return _png16(data, limits)
        case "TIFF":
            return _float_tiff(data, limits)
        case "NPY":
            return _npy(data, limits)
        case "SFD1":
            return read_raw16(data, limits, field=_FIELD)
        case _:
            raise _unsupported(f"a {format_} picture loses the depth it is given")


def opencv_decode(data: bytes, flags: int, *, field: str) -> NDArray[Any]:
    """Decode with OpenCV, in the stored orientation: intrinsics belong to the stored pixels, not to an EXIF note.

    Raises:
        DecodeError: OpenCV refuses the bytes.
    """
    try:
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise damaged(field, "its pixels are damaged or cut off") from error
    if picture is None:
        raise damaged(field, "its pixels are damaged or cut off")
    return picture


def _png16(data: bytes, limits: ImageLimits) -> Values:
    header = header_of(data, "PNG", field=_FIELD)
    if (header.channels, header.bits) != (1, 16):
        raise _unsupported(
            f"this PNG has {header.channels} channels of {header.bits} bits, and depth needs 1 of 16 (or, for a depth "
            'picture of CARLA, encoding "carla")'
        )
    require_pixels(header.height, header.width, limits, field=_FIELD)
    if is_plain_grey16(data):
        return read_grey16(data, header.height, header.width, field=_FIELD)
    return _of_size(opencv_decode(data, cv2.IMREAD_UNCHANGED, field=_FIELD), header.height, header.width)


def _carla(data: bytes, format_: str, limits: ImageLimits) -> Values:
    header = header_of(data, "PNG", field=_FIELD) if format_ == "PNG" else None
    if header is None or header.bits != 8 or header.channels not in (3, 4):
        raise _unsupported('encoding "carla" is a PNG with 3 or 4 channels of 8 bits, and this is none')
    require_pixels(header.height, header.width, limits, field=_FIELD)
    bgr = opencv_decode(data, cv2.IMREAD_UNCHANGED, field=_FIELD)
    if bgr.ndim != 3 or bgr.shape[:2] != (header.height, header.width):
        raise damaged(_FIELD, f"its pixels are {bgr.shape}, its header says {header.height}x{header.width}")
    b, g, r = (bgr[..., n].astype(np.uint32) for n in range(3))
    value = r + (g << 8) + (b << 16)
    return np.where(value == CARLA_FAR_VALUE, 0, value).astype(np.uint32)


def _float_tiff(data: bytes, limits: ImageLimits) -> Values:
    header = header_of(data, "TIFF", field=_FIELD)
    if not header.is_float or (header.channels, header.bits) != (1, 32):
        samples = f"{'float' if header.is_float else 'integer'} channels of {header.bits} bits"
        raise _unsupported(f"this TIFF has {header.channels} {samples}, and depth needs 1 float channel of 32")
    require_pixels(header.height, header.width, limits, field=_FIELD)
    return _of_size(opencv_decode(data, cv2.IMREAD_UNCHANGED, field=_FIELD), header.height, header.width)


def _npy(data: bytes, limits: ImageLimits) -> Values:
    stream = io.BytesIO(data)
    try:
        version = np.lib.format.read_magic(stream)
        reader = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }.get(version)
        if reader is None:
            raise _unsupported(f"NPY version {version[0]}.{version[1]} is for structured arrays")
        shape, is_fortran, dtype = reader(stream, max_header_size=_MAX_NPY_HEADER_BYTES)
    except NPY_HEADER_ERRORS as error:
        raise damaged(_FIELD, "its NPY header is damaged") from error
    if dtype.hasobject or dtype.str[1:] not in _NPY_DTYPES:
        raise _unsupported(f"NPY of type {dtype} is not read; save float32 (or float16, float64, uint16)")
    if len(shape) != 2 or min(shape) < 1:
        raise damaged(_FIELD, f"its NPY shape is {shape}, and depth needs (height, width)")
    require_pixels(shape[0], shape[1], limits, field=_FIELD)
    needed, there = shape[0] * shape[1] * dtype.itemsize, len(data) - stream.tell()
    if there != needed:
        raise damaged(_FIELD, f"the NPY has {there} bytes of values where its shape {shape} needs {needed}")
    values = np.frombuffer(data, dtype, offset=stream.tell()).reshape(shape, order="F" if is_fortran else "C")
    return values.astype(dtype.newbyteorder("="), copy=False)


def _of_size(values: NDArray[Any], height: int, width: int) -> Values:
    if values.shape != (height, width):
        raise damaged(_FIELD, f"its pixels are {values.shape}, its header says {height}x{width}")
    return values


def _unsupported(why: str) -> UnsupportedFormatError:
    return UnsupportedFormatError(
        f"The part `{_FIELD}` is not a depth picture that we read: {why}; send 16-bit PNG, 32-bit float TIFF or NPY.",
        field=_FIELD,
    )
