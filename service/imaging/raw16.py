"""Read and write raw16: depth as uint16 values, compressed by a fast general codec.

raw16 is the cheapest format to send and to read. The bytes are ``SFD1``, width and height as little-endian uint32, then one frame
of little-endian uint16 rows. The frame is zstd or lz4, and its first bytes tell the codec. zstd is a little smaller than PNG and
takes half of its time to read. lz4 is a quarter larger than zstd and takes three fifths of its time (29 November 2026, rows
``decode.depth.*`` of the reports; decision 0191).

The codecs are imported where they are used, because a client that sends encoded images needs neither.
"""

import struct
from typing import Any, Literal

import numpy as np
from jaxtyping import UInt16
from numpy.typing import NDArray

from service.errors import extra_missing
from service.imaging.picture_headers import ImageLimits, damaged, require_pixels

Codec = Literal["zstd", "lz4"]
Values = UInt16[NDArray[np.uint16], "H W"]

_HEADER = struct.Struct("<4sII")
_LZ4_FRAME = b"\x04\x22\x4d\x18"


def read_raw16(data: bytes, limits: ImageLimits, *, field: str) -> Values:
    """Decode a depth image that ``write_raw16`` wrote.

    Args:
        data: bytes of the image, with the signature ``SFD1``.
        limits: largest number of pixels.
        field: part of the request that errors name.

    Returns:
        Stored values, without a unit.

    Raises:
        DecodeError: the bytes are damaged or cut off, or their size differs from the header.
        TooLargeError: the image has more pixels than the limits allow.
    """
    if len(data) < _HEADER.size:
        raise damaged(field, "the raw16 header is cut off")
    _, width, height = _HEADER.unpack_from(data)
    if width < 1 or height < 1:
        raise damaged(field, f"the raw16 header states {width}x{height} pixels")
    require_pixels(height, width, limits, field=field)
    frame, needed = memoryview(data)[_HEADER.size :], 2 * width * height
    unpack = _from_lz4 if frame[:4] == _LZ4_FRAME else _from_zstd
    raw = unpack(frame, needed, f"but {width}x{height} pixels need {needed}", field)
    return np.frombuffer(raw, "<u2").reshape(height, width).astype(np.uint16, copy=False)


def write_raw16(values: NDArray[Any], codec: Codec = "zstd") -> bytes:
    """Encode a depth image as raw16.

    Args:
        values: (H, W), uint16 values as in a 16-bit PNG.
        codec: ``zstd`` for a slow link, ``lz4`` if processor time costs more than bytes.

    Raises:
        ExtraMissingError: the package of the codec is not installed.
    """
    height, width = values.shape
    raw = values.astype("<u2", copy=False).tobytes()
    frame = _lz4_frame(raw) if codec == "lz4" else _zstd_frame(raw)
    return _HEADER.pack(b"SFD1", width, height) + frame


def _zstd_frame(raw: bytes) -> bytes:
    try:
        import zstandard
    except ModuleNotFoundError as error:
        raise extra_missing("depth_codec 'zstd'", None, error) from error
    return zstandard.ZstdCompressor(level=1, write_content_size=True).compress(raw)


def _lz4_frame(raw: bytes) -> bytes:
    try:
        import lz4.frame
    except ModuleNotFoundError as error:
        raise extra_missing("depth_codec 'lz4'", "lz4", error) from error
    frame: bytes = lz4.frame.compress(raw, store_size=True)
    return frame


def _from_zstd(frame: memoryview, needed: int, where: str, field: str) -> bytes:
    import zstandard

    try:
        stated = zstandard.get_frame_parameters(frame).content_size
        if stated != needed:
            raise damaged(field, f"the zstd frame states {stated} bytes, {where}")
        raw = zstandard.ZstdDecompressor(max_window_size=2**27).decompress(
            frame, max_output_size=needed, allow_extra_data=False
        )
    except zstandard.ZstdError as error:
        raise damaged(field, "the zstd frame is damaged or cut off") from error
    if len(raw) != needed:
        raise damaged(field, f"the zstd frame has {len(raw)} bytes, {where}")
    return raw


def _from_lz4(frame: memoryview, needed: int, where: str, field: str) -> bytes:
    import lz4.frame

    unpacking = lz4.frame.LZ4FrameDecompressor()
    try:
        # One spare byte reveals a frame that is too long.
        raw: bytes = unpacking.decompress(frame, max_length=needed + 1)
    except (RuntimeError, EOFError) as error:
        raise damaged(field, "the lz4 frame is damaged or cut off") from error
    if len(raw) != needed or not unpacking.eof or unpacking.unused_data:
        has = "too many or too few" if len(raw) == needed else str(len(raw))
        raise damaged(field, f"the lz4 frame has {has} bytes, {where}")
    return raw
