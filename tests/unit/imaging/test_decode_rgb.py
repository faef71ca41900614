import contextlib
import struct
import zlib

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.errors import DecodeError, ImageSizeError, StreetfixError, TooLargeError, UnsupportedFormatError
from service.geometry.camera import PinholeCamera
from service.imaging.decode import ImageLimits, decode_rgb, require_sizes

LOSSLESS_WEBP = [cv2.IMWRITE_WEBP_QUALITY, 101]


def encoded(suffix, picture, parameters=()):
    ok, data = cv2.imencode(suffix, picture, list(parameters))
    assert ok
    return data.tobytes()


def noise(height=40, width=60, channels=3, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (height, width, channels), np.uint8)


def png_that_claims(width, height):
    def chunk(kind, body):
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(bytes(99))) + chunk(b"IEND", b"")
    )


def webp_that_claims(kind, body):
    chunk = kind + struct.pack("<I", len(body)) + body
    return b"RIFF" + struct.pack("<I", 4 + len(chunk)) + b"WEBP" + chunk


@pytest.mark.parametrize(("suffix", "parameters"), [(".png", ()), (".webp", LOSSLESS_WEBP)])
def test_lossless_pictures_come_back_in_rgb_order(suffix, parameters):
    bgr = noise()
    np.testing.assert_array_equal(decode_rgb(encoded(suffix, bgr, parameters)), bgr[..., ::-1])


@pytest.mark.parametrize("parameters", [[], [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]])
def test_jpeg_comes_back_in_rgb_order(parameters):
    red = np.zeros((16, 24, 3), np.uint8)
    red[..., 2] = 250
    rgb = decode_rgb(encoded(".jpg", red, parameters))
    assert rgb.shape == (16, 24, 3)
    np.testing.assert_allclose(rgb.mean(axis=(0, 1)), (250, 0, 0), atol=4)


def test_lossy_webp_is_read():
    assert decode_rgb(encoded(".webp", noise(), [cv2.IMWRITE_WEBP_QUALITY, 80])).shape == (40, 60, 3)


def test_grey_gets_three_channels_and_alpha_is_dropped():
    assert decode_rgb(encoded(".png", noise()[..., 0])).shape == (40, 60, 3)
    assert decode_rgb(encoded(".png", noise(channels=4))).shape == (40, 60, 3)
    assert decode_rgb(encoded(".webp", noise(channels=4), LOSSLESS_WEBP)).shape == (40, 60, 3)


def test_an_orientation_note_does_not_turn_the_picture():
    data = encoded(".jpg", noise(16, 24))
    exif = b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"
    turned = data[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + data[2:]
    assert decode_rgb(turned).shape == (16, 24, 3)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.95])
@pytest.mark.parametrize("suffix", [".png", ".jpg", ".webp"])
def test_a_picture_that_is_cut_off_is_refused(suffix, share):
    data = encoded(suffix, noise())
    with pytest.raises(DecodeError, match="send the whole file") as caught:
        decode_rgb(data[: int(share * len(data))])
    assert caught.value.field == "rgb"


def test_an_empty_part_is_refused():
    with pytest.raises(DecodeError, match="0 bytes"):
        decode_rgb(b"")


@pytest.mark.parametrize("data", [b"GIF89a" + bytes(40), b"%PDF-1.7", b"RIFF\x10\0\0\0WAVEfmt "])
def test_an_unknown_format_is_refused_with_its_first_bytes(data):
    with pytest.raises(UnsupportedFormatError, match=data[:4].hex(" ")):
        decode_rgb(data)


def test_a_depth_format_is_refused_as_colour():
    with pytest.raises(UnsupportedFormatError, match="TIFF"):
        decode_rgb(encoded(".tiff", np.ones((4, 4), np.float32)))


@pytest.mark.parametrize(
    "data",
    [
        png_that_claims(60_000, 60_000),
        b"\xff\xd8\xff\xc0\0\x11\x08" + struct.pack(">HHB", 65_000, 65_000, 3) + bytes(20) + b"\xff\xd9",
        webp_that_claims(b"VP8X", bytes(4) + (2**24 - 1).to_bytes(3, "little") * 2),
        webp_that_claims(b"VP8 ", b"\0\0\0\x9d\x01\x2a" + struct.pack("<HH", 16_383, 16_383)),
        webp_that_claims(b"VP8L", b"\x2f" + struct.pack("<I", 2**28 - 1)),
    ],
    ids=["PNG", "JPEG", "WebP extended", "WebP lossy", "WebP lossless"],
)
def test_a_bomb_is_refused_by_its_header_before_it_is_decoded(data, monkeypatch):
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("decoded"))
    with pytest.raises(TooLargeError, match="25000000"):
        decode_rgb(data)


def test_pixels_at_the_limit_are_read_and_one_more_is_not():
    data = encoded(".png", noise(10, 10))
    assert decode_rgb(data, limits=ImageLimits(max_pixels=100)).shape == (10, 10, 3)
    with pytest.raises(TooLargeError, match="10x10"):
        decode_rgb(data, limits=ImageLimits(max_pixels=99))


def test_too_many_bytes_are_refused():
    data = encoded(".png", noise())
    with pytest.raises(TooLargeError, match=str(len(data))):
        decode_rgb(data, limits=ImageLimits(max_bytes=len(data) - 1))


def test_a_png_chunk_beyond_the_data_is_refused_before_it_is_decoded(monkeypatch):
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("decoded"))
    data = bytearray(encoded(".png", noise()))
    data[33] = 0x7F  # the high byte of the first chunk's length: 2 GB
    with pytest.raises(DecodeError, match="cut off"):
        decode_rgb(bytes(data))


@pytest.mark.parametrize(
    "data",
    [
        png_that_claims(0, 5),
        png_that_claims(500, 500),
        png_that_claims(5, 5)[:33] + b"\0\0\0\0IDAT\0\0\0\0" * 50_001,
        b"\xff\xd8\xff\xda" + bytes(50),
        b"\xff\xd8" + b"\xff\xe0\0\x02" * 2000 + b"\xff\xd9",
        webp_that_claims(b"ICCP", bytes(40)),
    ],
    ids=[
        "no pixels",
        "too few data",
        "endless chunks",
        "scan without frame",
        "endless segments",
        "WebP without picture",
    ],
)
def test_a_damaged_picture_is_refused(data):
    with pytest.raises(DecodeError) as caught:
        decode_rgb(data)
    assert caught.value.field == "rgb"


@given(
    st.sampled_from([".png", ".jpg", ".webp"]),
    st.lists(st.tuples(st.integers(0, 200), st.integers(0, 255)), min_size=1, max_size=6),
)
def test_damaged_bytes_give_a_picture_or_an_error_of_ours(suffix, changes):
    data = bytearray(encoded(suffix, noise(8, 8)))
    for at, value in changes:
        data[at % len(data)] = value
    with contextlib.suppress(StreetfixError):
        assert decode_rgb(bytes(data), limits=ImageLimits(max_pixels=10_000)).ndim == 3


CAMERA = PinholeCamera(640, 480, 500.0, 500.0, 319.5, 239.5)


@pytest.mark.parametrize(
    ("rgb", "depth"), [((480, 640), (480, 640)), ((480, 640), (240, 320)), ((960, 1280), (120, 160))]
)
def test_pictures_at_any_uniform_scale_of_the_camera_fit(rgb, depth):
    require_sizes(np.zeros((*rgb, 3), np.uint8), np.zeros(depth, np.float32), CAMERA)


def test_depth_of_other_size_is_refused_with_both_sizes():
    with pytest.raises(ImageSizeError, match=r"320x180.*640x480") as caught:
        require_sizes(np.zeros((480, 640, 3), np.uint8), np.zeros((180, 320), np.float32), CAMERA)
    assert caught.value.field == "depth"


def test_rgb_of_other_size_is_refused_with_both_sizes():
    with pytest.raises(ImageSizeError, match=r"480x640.*640x480") as caught:
        require_sizes(np.zeros((640, 480, 3), np.uint8), np.zeros((480, 640), np.float32), CAMERA)
    assert caught.value.field == "rgb"


@pytest.mark.parametrize(
    ("width", "finest_px", "by"),
    [(640, 0.0, 1), (640, 1.9, 1), (640, 2.0, 2), (641, 3.9, 2), (640, 4.0, 4), (637, 8.0, 8), (640, 99.0, 8)],
)
def test_a_jpeg_is_decoded_no_finer_than_is_wanted(width, finest_px, by):
    """``finest_px``: number of image pixels per required pixel."""
    v, u = np.mgrid[:120, :width]
    picture = np.stack([u * 255 // width, v * 2, 0 * u], axis=-1).astype(np.uint8)
    data = cv2.imencode(".jpg", picture[..., ::-1], (cv2.IMWRITE_JPEG_QUALITY, 100))[1].tobytes()
    camera = PinholeCamera(2 * width, 240, 400.0, 400.0, width - 0.5, 119.5)  # the picture is half of the camera's
    found = decode_rgb(data, camera=camera, finest_rad=finest_px / 200.0)
    assert found.shape == (-(-120 // by), -(-width // by), 3)
    wanted = cv2.resize(picture, (found.shape[1], found.shape[0]), interpolation=cv2.INTER_AREA).astype(float)
    assert np.abs(found - wanted)[1:-1, 1:-1].mean() < 2.5


def test_only_a_jpeg_is_decoded_coarser():
    data = cv2.imencode(".png", np.zeros((48, 64, 3), np.uint8))[1].tobytes()
    camera = PinholeCamera(64, 48, 32.0, 32.0, 31.5, 23.5)
    assert decode_rgb(data, camera=camera, finest_rad=1.0).shape == (48, 64, 3)
