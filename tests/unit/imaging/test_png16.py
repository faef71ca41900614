"""The fast PNG reader against that of OpenCV, and its errors for damaged files."""

import itertools
import resource
import struct
import zlib

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.errors import DecodeError, StreetfixError
from service.imaging import depth16
from service.imaging.depth_formats import read_depth_values
from service.imaging.picture_headers import DEFAULT_LIMITS
from service.imaging.png16 import is_plain_grey16, read_grey16

SIGNATURE = b"\x89PNG\r\n\x1a\n"


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(pixels: np.ndarray, filters, *, pieces: int = 1, extra: bytes = b"", bits: int = 16) -> bytes:
    """Encode a PNG with given row filters, by the definitions of RFC 2083."""
    height, width = pixels.shape
    rows = pixels.astype(">u2").view(np.uint8).reshape(height, 2 * width).astype(int)
    raw = bytearray()
    for y in range(height):
        up = rows[y - 1] if y else np.zeros(2 * width, int)
        left = np.r_[0, 0, rows[y, :-2]]
        corner = np.r_[0, 0, up[:-2]]
        estimate = left + up - corner
        near = [np.abs(estimate - each) for each in (left, up, corner)]
        paeth = np.where((near[0] <= near[1]) & (near[0] <= near[2]), left, np.where(near[1] <= near[2], up, corner))
        guess = [0 * left, left, up, (left + up) // 2, paeth]
        kind = filters[y % len(filters)]
        raw.append(kind)
        raw += bytes(((rows[y] - (guess[kind] if kind < 5 else 0)) % 256).astype(np.uint8))
    data = zlib.compress(bytes(raw) + extra)
    cut = np.linspace(0, len(data), pieces + 1).astype(int)
    body = b"".join(chunk(b"IDAT", data[a:b]) for a, b in itertools.pairwise(cut))
    header = struct.pack(">IIBBBBB", width, height, bits, 0, 0, 0, 0)
    return SIGNATURE + chunk(b"IHDR", header) + chunk(b"tEXt", b"note\0depth") + body + chunk(b"IEND", b"")


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    height=st.integers(1, 9),
    width=st.integers(1, 9),
    filters=st.lists(st.integers(0, 4), min_size=1, max_size=9),
    pieces=st.integers(1, 4),
    smooth=st.booleans(),
)
def test_pixels_are_those_that_were_written_and_that_opencv_reads(seed, height, width, filters, pieces, smooth):
    rng = np.random.default_rng(seed)
    pixels = rng.integers(0, 300 if smooth else 65536, (height, width)).astype(np.uint16)
    data = png(pixels, filters, pieces=pieces)
    assert is_plain_grey16(data)
    np.testing.assert_array_equal(read_grey16(data, height, width, field="depth"), pixels)
    np.testing.assert_array_equal(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED), pixels)


def test_a_depth_cameras_picture_is_read_as_opencv_reads_it():
    depth = (np.add.outer(np.arange(480), np.arange(640)) % 40000).astype(np.uint16)
    for level in (0, 1, 6, 9):
        data = cv2.imencode(".png", depth, [cv2.IMWRITE_PNG_COMPRESSION, level])[1].tobytes()
        np.testing.assert_array_equal(read_depth_values(data, encoding=None, limits=DEFAULT_LIMITS), depth)


def test_an_unusual_png_goes_to_opencv():
    colour = cv2.imencode(".png", np.zeros((3, 4, 3), np.uint16))[1].tobytes()
    grey8 = cv2.imencode(".png", np.zeros((3, 4), np.uint8))[1].tobytes()
    interlaced = bytearray(png(np.zeros((3, 4), np.uint16), [0]))
    interlaced[28] = 1
    assert not any(is_plain_grey16(bytes(each)) for each in (colour, grey8, interlaced))


HEAD = SIGNATURE + chunk(b"IHDR", struct.pack(">IIBBBBB", 4, 3, 16, 0, 0, 0, 0))
PIXELS = np.arange(12, dtype=np.uint16).reshape(3, 4)


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (png(PIXELS, [7]), "row 0 has an unknown filter"),
        (png(PIXELS, [0, 0, 9]), "row 2 has an unknown filter"),
        (png(PIXELS, [0], extra=b"x"), "have 28 bytes, but 4x3 pixels need 27"),
        (png(PIXELS[:2], [0]), "have 18 bytes, but 4x3 pixels need 27"),
        (png(PIXELS, [0])[:-20], "cut off"),
        (png(PIXELS, [0]).replace(b"note", b"nope"), "checksum of the chunk"),
        (HEAD + chunk(b"IDAT", b"not zlib") + chunk(b"IEND", b""), "damaged"),
        (HEAD + chunk(b"IEND", b""), "damaged"),
        (HEAD + chunk(b"IDAT", zlib.compress(bytes(27))[:-1] + b"?") + chunk(b"IEND", b""), "damaged"),
    ],
)
def test_a_damaged_file_says_what_is_wrong(data, says):
    with pytest.raises(DecodeError, match=says):
        read_grey16(data, 3, 4, field="depth")


def test_a_bomb_is_inflated_no_further_than_the_picture_needs():
    """A header of 3 x 4 pixels precedes a gigabyte of compressed zeros."""
    packed = zlib.compressobj(wbits=-15)
    # After a full flush nothing refers to earlier data, so the block of a mebibyte may be repeated.
    mebibyte = packed.compress(bytes(2**20)) + packed.flush(zlib.Z_FULL_FLUSH)
    adler32 = struct.pack(">I", 2**30 % 65521 << 16 | 1)  # of 2**30 zeros
    body = b"\x78\x9c" + 1024 * mebibyte + packed.flush() + adler32
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(DecodeError, match="longer than the header states"):
        read_grey16(HEAD + chunk(b"IDAT", body) + chunk(b"IEND", b""), 3, 4, field="depth")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 64 * 1024  # KiB


def test_a_missing_library_says_what_to_do(monkeypatch, tmp_path):
    monkeypatch.setattr(depth16, "LIBRARY", tmp_path / "_depth16.so")
    depth16.library.cache_clear()
    with pytest.raises(StreetfixError, match=r"_depth16\.so is missing .* install the package again"):
        depth16.library()
    depth16.library.cache_clear()
