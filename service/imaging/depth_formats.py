"""Read depth images as arrays of raw values. ``depth_units`` converts these values to metres.

Every reader first checks the size that the header states against the limits. Only then does the reader touch the data.
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

#: How a depth image is encoded. ``auto`` (like None): the first bytes decide. ``carla``: depth of CARLA in three channels of an
#: 8-bit PNG. ``compressed_depth``: data of a ROS message of compressed_depth_image_transport, PNG or RVL.
DepthEncoding = Literal["auto", "carla", "compressed_depth"]
Values = Shaped[NDArray[Any], "H W"]

#: Stored value of CARLA's far plane. The ray hit nothing, so this value counts as not measured.
CARLA_FAR_VALUE = 2**24 - 1
_MAX_NPY_HEADER_BYTES = 1024
_NPY_DTYPES = frozenset({"f2", "f4", "f8", "u2"})
_FIELD = "depth"


def read_depth_values(data: bytes, *, encoding: DepthEncoding | None, limits: ImageLimits) -> Values:
    """Read the raw values of a depth image.

    Args:
        data: bytes of the image. Formats: 16-bit grey PNG, 8-bit colour PNG of CARLA (``encoding="carla"``), float TIFF,
            NPY of float16, float32, float64 or uint16, raw16 (``service.imaging.raw16``), and the data of ROS compressedDepth
            (``encoding="compressed_depth"``, see ``service.imaging.ros_depth``).
        encoding: how to read the bytes. ``auto`` or None: the first bytes decide.
        limits: largest number of bytes and pixels.

    Returns:
        Stored values. Integers are uint16 (CARLA: uint32, with 0 for the far plane), all others are floating. Inverse depth of
        ROS compressedDepth is already converted to float32 metres.

    Raises:
        DecodeError: the bytes are damaged, cut off or missing.
        UnsupportedFormatError: the format or the sample type is not read as depth.
        TooLargeError: the image has more bytes or pixels than the limits allow.
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
            why = "is lossy" if format_ == "JPEG" else "has only 8 bits per channel"
            raise _unsupported(f"{format_} {why} and cannot store depth")


def opencv_decode(data: bytes, flags: int, *, field: str) -> NDArray[Any]:
    """Decode an image with OpenCV in its stored orientation.

    Intrinsics belong to the stored pixels, so an EXIF rotation must not be applied. The caller's flags ensure this.

    Args:
        data: bytes of the encoded image.
        flags: flags of ``cv2.imdecode``.
        field: part of the request that the error names.

    Returns:
        Pixels, (H, W) or (H, W, C). The flags decide the number of channels, their order and the type.

    Raises:
        DecodeError: OpenCV cannot decode the bytes.
    """
    try:
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise damaged(field, "the pixel data are damaged or cut off") from error
    if picture is None:
        raise damaged(field, "the pixel data are damaged or cut off")
    return picture


def _png16(data: bytes, limits: ImageLimits) -> Values:
    header = header_of(data, "PNG", field=_FIELD)
    if (header.channels, header.bits) != (1, 16):
        raise _unsupported(
            f"this PNG has {header.channels} channels of {header.bits} bits, but depth needs 1 channel of 16 bits (a depth "
            'image from CARLA needs encoding "carla")'
        )
    require_pixels(header.height, header.width, limits, field=_FIELD)
    if is_plain_grey16(data):
        return read_grey16(data, header.height, header.width, field=_FIELD)
    return _of_size(opencv_decode(data, cv2.IMREAD_UNCHANGED, field=_FIELD), header.height, header.width)


def _carla(data: bytes, format_: str, limits: ImageLimits) -> Values:
    header = header_of(data, "PNG", field=_FIELD) if format_ == "PNG" else None
    if header is None or header.bits != 8 or header.channels not in (3, 4):
        raise _unsupported('encoding "carla" needs a PNG with 3 or 4 channels of 8 bits')
    require_pixels(header.height, header.width, limits, field=_FIELD)
    bgr = opencv_decode(data, cv2.IMREAD_UNCHANGED, field=_FIELD)
    if bgr.ndim != 3 or bgr.shape[:2] != (header.height, header.width):
        raise damaged(_FIELD, f"the decoded shape is {bgr.shape}, but the header states {header.height}x{header.width}")
    b, g, r = (bgr[..., n].astype(np.uint32) for n in range(3))
    value = r + (g << 8) + (b << 16)
    return np.where(value == CARLA_FAR_VALUE, 0, value).astype(np.uint32)


def _float_tiff(data: bytes, limits: ImageLimits) -> Values:
    header = header_of(data, "TIFF", field=_FIELD)
    if not header.is_float or (header.channels, header.bits) != (1, 32):
        samples = f"{'float' if header.is_float else 'integer'} channels of {header.bits} bits"
        raise _unsupported(f"this TIFF has {header.channels} {samples}, but depth needs 1 float channel of 32 bits")
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
            raise _unsupported(f"NPY version {version[0]}.{version[1]} (structured arrays) is not supported")
        shape, is_fortran, dtype = reader(stream, max_header_size=_MAX_NPY_HEADER_BYTES)
    except NPY_HEADER_ERRORS as error:
        raise damaged(_FIELD, "the NPY header is damaged") from error
    if dtype.hasobject or dtype.str[1:] not in _NPY_DTYPES:
        raise _unsupported(f"the NPY type {dtype} is not supported (use float32, float16, float64 or uint16)")
    if len(shape) != 2 or min(shape) < 1:
        raise damaged(_FIELD, f"the NPY shape is {shape}, but depth needs (height, width)")
    require_pixels(shape[0], shape[1], limits, field=_FIELD)
    needed, stored = shape[0] * shape[1] * dtype.itemsize, len(data) - stream.tell()
    if stored != needed:
        raise damaged(_FIELD, f"the NPY has {stored} bytes of values, but its shape {shape} needs {needed}")
    values = np.frombuffer(data, dtype, offset=stream.tell()).reshape(shape, order="F" if is_fortran else "C")
    return values.astype(dtype.newbyteorder("="), copy=False)


def _of_size(values: NDArray[Any], height: int, width: int) -> Values:
    if values.shape != (height, width):
        raise damaged(_FIELD, f"the decoded shape is {values.shape}, but the header states {height}x{width}")
    return values


def _unsupported(why: str) -> UnsupportedFormatError:
    return UnsupportedFormatError(
        f"The part `{_FIELD}` is not a supported depth image: {why}; send 16-bit PNG, 32-bit float TIFF or NPY.",
        field=_FIELD,
    )
