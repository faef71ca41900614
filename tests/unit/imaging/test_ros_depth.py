"""compressedDepth against an encoder from the publication, and the errors for damaged data."""

import contextlib
import struct

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.errors import DecodeError, TooLargeError
from service.geometry.camera import PinholeCamera
from service.imaging.decode import decode_depth
from service.imaging.picture_headers import ImageLimits
from service.imaging.ros_depth import read_ros_depth

LIMITS = ImageLimits(max_pixels=10_000)


def rvl(values: np.ndarray) -> bytes:
    """Encode by Wilson, ISS 2017: runs of zeros, runs of zigzag differences, groups of three bits in nibbles."""
    nibbles: list[int] = []

    def write(number: int) -> None:
        while True:
            group, number = number & 7, number >> 3
            nibbles.append(group | (8 if number else 0))
            if not number:
                return

    flat, at, before = values.reshape(-1).astype(int).tolist(), 0, 0
    while at < len(flat):
        zeros = next((k for k, v in enumerate(flat[at:]) if v), len(flat) - at)
        at += zeros
        some = next((k for k, v in enumerate(flat[at:]) if not v), len(flat) - at)
        write(zeros)
        write(some)
        for value in flat[at : at + some]:
            step, before = value - before, value
            write(2 * step if step >= 0 else -2 * step - 1)
        at += some
    nibbles += [0] * (-len(nibbles) % 8)
    words = [sum(n << (28 - 4 * k) for k, n in enumerate(nibbles[i : i + 8])) for i in range(0, len(nibbles), 8)]
    return struct.pack(f"<ii{len(words)}I", values.shape[1], values.shape[0], *words)


def message(body: bytes, *, a: float = 0.0, b: float = 0.0) -> bytes:
    return struct.pack("<iff", 0, a, b) + body


@settings(max_examples=80, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), height=st.integers(1, 12), width=st.integers(1, 12), holes=st.floats(0, 1))
def test_rvl_is_read_as_it_was_written(seed, height, width, holes):
    rng = np.random.default_rng(seed)
    values = rng.integers(1, rng.choice([5, 3000, 65536]), (height, width)).astype(np.uint16)
    values[rng.random(values.shape) < holes] = 0
    np.testing.assert_array_equal(read_ros_depth(message(rvl(values)), LIMITS, field="depth"), values)


def test_png_is_read_and_millimetres_become_metres():
    values = np.arange(12, dtype=np.uint16).reshape(3, 4) * 500
    data = message(cv2.imencode(".png", values)[1].tobytes())
    depth_m = decode_depth(data, camera=PinholeCamera(4, 3, 4.0, 4.0, 1.5, 1.0), encoding="compressed_depth")
    np.testing.assert_allclose(depth_m, values / 1000)


def test_inverse_depth_becomes_metres():
    """A = 100 and B = 0.5: the value 20 is 100 / 19.5 m. 0 means no measurement."""
    values = np.array([[0, 20, 60]], np.uint16)
    depth_m = decode_depth(
        message(rvl(values), a=100.0, b=0.5),
        camera=PinholeCamera(3, 1, 4.0, 4.0, 1.0, 0.0),
        encoding="compressed_depth",
    )
    np.testing.assert_allclose(depth_m, [[0, 100 / 19.5, 100 / 59.5]], rtol=1e-6)


GOOD = rvl(np.arange(1, 13, dtype=np.uint16).reshape(3, 4))


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"123", "header is cut off"),
        (message(b"\x00\x00"), "size is cut off"),
        (message(struct.pack("<ii", -4, 3)), "is -4x3 pixels"),
        (message(GOOD[:8]), "after 0 of 12 pixels"),
        (message(GOOD[:12]), "after . of 12 pixels"),
        (message(GOOD[:8] + b"\xff" * 40), "cut off or invalid after 0 of 12"),
        (message(GOOD[:8] + bytes(40)), "cut off or invalid after 0 of 12"),  # runs of nothing, for ever
        (message(GOOD, a=float("nan")), "compressedDepth header states"),
        (message(cv2.imencode(".png", np.zeros((3, 4), np.uint8))[1].tobytes()), "not 16-bit grey"),
        (message(b"\x89PNG\r\n\x1a\n" + bytes(30)), "PNG"),
    ],
)
def test_damaged_data_say_what_is_wrong(data, says):
    with pytest.raises(DecodeError, match=says):
        read_ros_depth(data, LIMITS, field="depth")


def test_a_size_beyond_the_limit_is_refused_before_memory_is_taken():
    with pytest.raises(TooLargeError):
        read_ros_depth(message(struct.pack("<ii", 2**31 - 1, 2**31 - 1)), LIMITS, field="depth")


@given(data=st.binary(max_size=60))
def test_any_bytes_are_read_or_refused(data):
    with contextlib.suppress(DecodeError):
        read_ros_depth(message(struct.pack("<ii", 8, 8) + data), LIMITS, field="depth")
