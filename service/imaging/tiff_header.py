"""Read size and sample type from the first directory of a TIFF (TIFF 6.0, sections 2 and 8)."""

import struct
from dataclasses import dataclass

_WIDTH, _HEIGHT, _BITS, _CHANNELS, _TILE_WIDTH, _TILE_HEIGHT, _SAMPLE_FORMAT = 256, 257, 258, 277, 322, 323, 339
_NEEDED = frozenset({_WIDTH, _HEIGHT, _BITS, _CHANNELS, _TILE_WIDTH, _TILE_HEIGHT, _SAMPLE_FORMAT})
#: Field types of whole numbers: BYTE, SHORT, LONG.
_TYPES = {1: "B", 3: "H", 4: "I"}
#: Values up to this size lie in the directory entry itself. Larger ones lie at an offset.
_INLINE_BYTES = 4


@dataclass(frozen=True, slots=True)
class TiffTags:
    """Size and sample type of a TIFF.

    Attributes:
        height: rows, pixels.
        width: columns, pixels.
        channels: samples per pixel.
        bits: bits per sample.
        sample_format: 1 unsigned, 2 signed, 3 IEEE float.
        tile_pixels: pixels per tile, 0 without tiles.
    """

    height: int
    width: int
    channels: int
    bits: int
    sample_format: int
    tile_pixels: int


def read_tiff_tags(data: bytes) -> TiffTags | None:
    """Read the tags that determine the memory for decoding. Return None if the directory is damaged.

    A repeated tag counts as damage, because decoders differ on which one they use.

    Args:
        data: bytes of the file.

    Raises:
        struct.error: the directory lies beyond the end of the data.
    """
    order = "<" if data[:2] == b"II" else ">"
    (start,) = struct.unpack_from(order + "I", data, 4)
    (count,) = struct.unpack_from(order + "H", data, start)
    found: dict[int, int] = {}
    for n in range(count):
        tag, kind, values = struct.unpack_from(order + "HHI", data, start + 2 + 12 * n)
        if tag not in _NEEDED:
            continue
        if tag in found or kind not in _TYPES or values < 1:
            return None
        at = start + 2 + 12 * n + 8
        if values * struct.calcsize(_TYPES[kind]) > _INLINE_BYTES:
            (at,) = struct.unpack_from(order + "I", data, at)
        (found[tag],) = struct.unpack_from(order + _TYPES[kind], data, at)
    if _WIDTH not in found or _HEIGHT not in found:
        return None
    return TiffTags(
        height=found[_HEIGHT],
        width=found[_WIDTH],
        channels=found.get(_CHANNELS, 1),
        bits=found.get(_BITS, 1),
        sample_format=found.get(_SAMPLE_FORMAT, 1),
        tile_pixels=found.get(_TILE_WIDTH, 0) * found.get(_TILE_HEIGHT, 0),
    )
