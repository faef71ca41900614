"""Read size and sample type of an image from its header, to enforce limits before decoding allocates memory.

An image of a few hundred bytes may need gigabytes when it is decoded. These readers look at headers only. They allocate nothing
and follow a bounded number of segments. OpenCV does the decoding.
"""

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from service.errors import DecodeError, TooLargeError, UnsupportedFormatError
from service.imaging.tiff_header import read_tiff_tags

Format = Literal["JPEG", "PNG", "WebP", "TIFF", "NPY", "SFD1"]

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_MAGIC: tuple[tuple[bytes, Format], ...] = (
    (b"\xff\xd8\xff", "JPEG"),
    (_PNG_SIGNATURE, "PNG"),
    (b"II*\x00", "TIFF"),
    (b"MM\x00*", "TIFF"),
    (b"\x93NUMPY", "NPY"),
    (b"SFD1", "SFD1"),
)
_MAX_JPEG_SEGMENTS = 1000
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_JPEG_BARE = frozenset({0x01, *range(0xD0, 0xD8)})
_PNG_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
#: Size of length, kind and checksum of a chunk, bytes.
_PNG_CHUNK_FRAME = 12
_MAX_PNG_CHUNKS = 50_000


@dataclass(frozen=True, slots=True)
class ImageLimits:
    """Limits on the cost of an image.

    Ours, 2026-11: a PNG of a 4K camera fits, a decompression bomb does not.

    Attributes:
        max_bytes: largest size of the encoded part, bytes.
        max_pixels: largest width x height of the decoded image.
        reserve: called with the field and the number of pixels, after the header is read and before the image is decoded. It may
            raise.
    """

    max_bytes: int = 32 * 2**20
    max_pixels: int = 25_000_000
    reserve: Callable[[str, int], None] | None = None


#: Limits where the caller gives none.
DEFAULT_LIMITS = ImageLimits()


@dataclass(frozen=True, slots=True)
class PictureHeader:
    """Size and sample type that the header of an image states.

    Attributes:
        height: rows, pixels.
        width: columns, pixels.
        channels: samples per pixel.
        bits: bits per sample.
        is_float: whether samples are IEEE floating values.
    """

    height: int
    width: int
    channels: int
    bits: int
    is_float: bool = False


def format_of(data: bytes, *, field: str) -> Format:
    """Detect the format of an image from its first bytes.

    Args:
        data: bytes of the encoded image.
        field: part of the request that errors name.

    Raises:
        DecodeError: there are no bytes.
        UnsupportedFormatError: the format is none of ``Format``.
    """
    if not data:
        raise DecodeError(f"The part `{field}` is empty (0 bytes); send the bytes of an image file.", field=field)
    for magic, name in _MAGIC:
        if data.startswith(magic):
            return name
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
        return "WebP"
    raise UnsupportedFormatError(
        f"The format of `{field}` is unknown (the first bytes are {data[:8].hex(' ')}); send colour as JPEG, PNG or WebP, "
        "and depth as 16-bit PNG, float TIFF or NPY.",
        field=field,
    )


def header_of(data: bytes, format_: Format, *, field: str) -> PictureHeader:
    """Read the header of a JPEG, PNG, WebP or TIFF.

    Args:
        data: bytes of the encoded image.
        format_: its format, from ``format_of``: JPEG, PNG, WebP or TIFF.
        field: part of the request that errors name.

    Raises:
        DecodeError: the header is damaged, or the file is cut off.
    """
    readers = {"JPEG": _jpeg, "PNG": _png, "WebP": _webp, "TIFF": _tiff}
    try:
        header = readers[format_](data, field)
    except (struct.error, IndexError) as error:
        raise damaged(field, f"the {format_} header is cut off") from error
    if header.width < 1 or header.height < 1:
        raise damaged(field, f"the {format_} header states {header.width}x{header.height} pixels")
    return header


def require_bytes(data: bytes, limits: ImageLimits, *, field: str) -> None:
    """Refuse a part with too many bytes.

    Args:
        data: bytes of the part.
        limits: limits of the request.
        field: part of the request that errors name.

    Raises:
        TooLargeError: the part has more than ``limits.max_bytes`` bytes.
    """
    if len(data) > limits.max_bytes:
        raise TooLargeError(
            f"The part `{field}` has {len(data)} bytes, but the limit is {limits.max_bytes}; "
            "send a smaller or more compressed image.",
            field=field,
        )


def require_pixels(height: int, width: int, limits: ImageLimits, *, field: str) -> None:
    """Refuse an image with too many pixels, and reserve what its decoding needs.

    Args:
        height: rows that the header states, pixels.
        width: columns that the header states, pixels.
        limits: limits of the request.
        field: part of the request that errors name.

    Raises:
        TooLargeError: the image has more than ``limits.max_pixels`` pixels.
        StreetfixError: ``limits.reserve`` has no room for the image.
    """
    if height * width > limits.max_pixels:
        raise TooLargeError(
            f"The image `{field}` has {width}x{height} pixels, but the limit is {limits.max_pixels} pixels; "
            "resize the image.",
            field=field,
        )
    if limits.reserve is not None:
        limits.reserve(field, height * width)


def damaged(field: str, why: str) -> DecodeError:
    """Make the error for an image whose bytes do not match its format or its header.

    Args:
        field: part of the request that the error names.
        why: what is wrong, as a clause of the error message.
    """
    return DecodeError(f"The image `{field}` cannot be decoded: {why}; send the whole file unchanged.", field=field)


def _png(data: bytes, field: str) -> PictureHeader:
    length, kind, width, height, bits, colour = struct.unpack_from(">I4sIIBB", data, 8)
    if kind != b"IHDR" or length != 13 or colour not in _PNG_CHANNELS:
        raise damaged(field, "the PNG does not begin with an IHDR chunk")
    _require_png_chunks(data, field)
    return PictureHeader(height, width, _PNG_CHANNELS[colour], bits)


def _require_png_chunks(data: bytes, field: str) -> None:
    """Refuse a PNG with a chunk that reaches beyond the data, with too many chunks, or without an end.

    Decoders allocate the stated size of a chunk before they read it.
    """
    at = len(_PNG_SIGNATURE)
    for _ in range(_MAX_PNG_CHUNKS):
        length, kind = struct.unpack_from(">I4s", data, at)
        at += _PNG_CHUNK_FRAME + length
        if at > len(data):
            raise damaged(field, f"the PNG is cut off (its chunk {kind.hex(' ')} ends at byte {at} of {len(data)})")
        if kind == b"IEND":
            return
    raise damaged(field, f"the PNG has more than {_MAX_PNG_CHUNKS} chunks")


def _jpeg(data: bytes, field: str) -> PictureHeader:
    at = 2
    for _ in range(_MAX_JPEG_SEGMENTS):
        marker, code = struct.unpack_from(">BB", data, at)
        if marker != 0xFF:
            break
        if code == 0xFF or code in _JPEG_BARE:
            at += 1 if code == 0xFF else 2
            continue
        if code in _JPEG_FRAMES:
            bits, height, width, channels = struct.unpack_from(">BHHB", data, at + 4)
            if data.rfind(b"\xff\xd9") < at:
                raise damaged(field, "the JPEG is cut off (no end marker)")
            return PictureHeader(height, width, channels, bits)
        if code in (0xD9, 0xDA):
            break
        at += 2 + max(2, struct.unpack_from(">H", data, at + 2)[0])
    raise damaged(field, "the JPEG has no frame header")


def _webp(data: bytes, field: str) -> PictureHeader:
    (size,) = struct.unpack_from("<I", data, 4)
    if len(data) < size + 8:
        raise damaged(field, f"the WebP is cut off ({len(data)} of {size + 8} bytes)")
    kind = data[12:16]
    if kind == b"VP8X":
        w, h = int.from_bytes(data[24:27], "little"), int.from_bytes(data[27:30], "little")
        return PictureHeader(h + 1, w + 1, 4 if data[20] & 0x10 else 3, 8)
    if kind == b"VP8 " and data[23:26] == b"\x9d\x01\x2a":
        w, h = struct.unpack_from("<HH", data, 26)
        return PictureHeader(h & 0x3FFF, w & 0x3FFF, 3, 8)
    if kind == b"VP8L" and data[20] == 0x2F:
        (packed,) = struct.unpack_from("<I", data, 21)
        return PictureHeader((packed >> 14 & 0x3FFF) + 1, (packed & 0x3FFF) + 1, 4, 8)
    raise damaged(field, "the WebP header is not VP8, VP8L or VP8X")


def _tiff(data: bytes, field: str) -> PictureHeader:
    tags = read_tiff_tags(data)
    if tags is None:
        raise damaged(field, "the first TIFF directory is incomplete or inconsistent")
    if tags.tile_pixels > tags.width * tags.height + 2**20:
        raise damaged(field, f"the TIFF tiles have {tags.tile_pixels} pixels, more than the image")
    return PictureHeader(tags.height, tags.width, tags.channels, tags.bits, tags.sample_format == 3)
