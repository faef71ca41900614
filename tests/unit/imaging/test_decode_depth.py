import contextlib
import io
import pickle
import struct

import cv2
import lz4.frame
import numpy as np
import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st

from service.errors import DecodeError, RequestError, StreetfixError, TooLargeError, UnsupportedFormatError
from service.geometry.camera import PinholeCamera
from service.geometry.distortion import rays_of
from service.imaging.decode import ImageLimits, decode_depth, default_scale_m
from service.imaging.raw16 import write_raw16

CAMERA = PinholeCamera(6, 4, 5.0, 5.0, 2.5, 1.5)


def encoded(suffix, picture, parameters=()):
    ok, data = cv2.imencode(suffix, picture, list(parameters))
    assert ok
    return data.tobytes()


def npy(array, version=(1, 0)):
    stream = io.BytesIO()
    np.lib.format.write_array(stream, array, version=version, allow_pickle=False)
    return stream.getvalue()


def npy_that_claims(header):
    body = header.encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(body)) + body


def tiff(picture):
    return encoded(".tiff", picture, [cv2.IMWRITE_TIFF_COMPRESSION, cv2.IMWRITE_TIFF_COMPRESSION_NONE])


def sfd1(values, *, width=None, height=None, content_size=True):
    h, w = values.shape
    frame = zstandard.ZstdCompressor(write_content_size=content_size).compress(values.astype("<u2").tobytes())
    return b"SFD1" + struct.pack("<II", width or w, height or h) + frame


def lz4_sfd1(values, *, width=None, store_size=True):
    h, w = values.shape
    frame = lz4.frame.compress(values.astype("<u2").tobytes(), store_size=store_size)
    return b"SFD1" + struct.pack("<II", width or w, h) + frame


def millimetres():
    return np.arange(24, dtype=np.uint16).reshape(4, 6) * 1000


def metres():
    return np.arange(24, dtype=np.float32).reshape(4, 6)


@pytest.mark.parametrize(
    "data", [encoded(".png", millimetres()), sfd1(millimetres()), lz4_sfd1(millimetres()), npy(millimetres())]
)
def test_16_bit_values_are_millimetres_unless_a_scale_is_given(data):
    np.testing.assert_allclose(decode_depth(data, camera=CAMERA), metres())
    np.testing.assert_allclose(decode_depth(data, camera=CAMERA, scale_m=1 / 256), metres() * 1000 / 256, rtol=1e-6)


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64, ">f4"])
def test_npy_of_floats_holds_metres(dtype):
    depth = decode_depth(npy(metres().astype(dtype)), camera=CAMERA)
    np.testing.assert_array_equal(depth, metres())
    assert depth.dtype == np.float32


def test_npy_in_fortran_order_and_version_2_is_read():
    np.testing.assert_array_equal(decode_depth(npy(np.asfortranarray(metres())), camera=CAMERA), metres())
    np.testing.assert_array_equal(decode_depth(npy(metres(), (2, 0)), camera=CAMERA), metres())


def test_a_scale_is_obeyed_for_floats_too():
    np.testing.assert_allclose(decode_depth(npy(metres() * 1000), camera=CAMERA, scale_m=0.001), metres(), rtol=1e-6)


@pytest.mark.parametrize("compression", [cv2.IMWRITE_TIFF_COMPRESSION_NONE, cv2.IMWRITE_TIFF_COMPRESSION_LZW])
def test_float_tiff_holds_metres(compression):
    data = encoded(".tiff", metres(), [cv2.IMWRITE_TIFF_COMPRESSION, compression])
    np.testing.assert_array_equal(decode_depth(data, camera=CAMERA), metres())


# By hand: R + 256 G + 65536 B of 2^24 - 1, times 1000 m. (R, G, B) = (10, 20, 30) is 1971210, so 117.4933 m.
@pytest.mark.parametrize("channels", [3, 4])
def test_carla_depth_is_read_from_its_three_channels(channels):
    picture = np.zeros((4, 6, channels), np.uint8)
    picture[..., :3] = (30, 20, 10)  # OpenCV writes B, G, R
    picture[0, 0, :3] = 255
    depth = decode_depth(encoded(".png", picture), camera=CAMERA, encoding="carla")
    np.testing.assert_allclose(depth[1:], 1971210 / 16777215 * 1000, rtol=1e-6)
    assert depth[0, 0] == 0  # the far plane: nothing was hit


@pytest.mark.parametrize("picture", [np.zeros((4, 6, 3), np.uint8), np.zeros((4, 6), np.uint8)])
def test_8_bit_png_is_refused_and_carla_is_named(picture):
    with pytest.raises(UnsupportedFormatError, match="carla") as caught:
        decode_depth(encoded(".png", picture), camera=CAMERA)
    assert caught.value.field == "depth"


@pytest.mark.parametrize("data", [encoded(".png", millimetres()), npy(metres())])
def test_a_file_that_is_no_colour_png_is_refused_as_carla_depth(data):
    with pytest.raises(UnsupportedFormatError, match="carla"):
        decode_depth(data, camera=CAMERA, encoding="carla")


def test_unusable_values_become_no_measurement():
    values = np.array([[np.nan, np.inf, -np.inf, -1.0, 0.0, 2.0]], np.float32).repeat(4, 0)
    for data in (npy(values), tiff(values), npy(values.astype(np.float64))):
        np.testing.assert_array_equal(decode_depth(data, camera=CAMERA), [[0, 0, 0, 0, 0, 2]] * 4)


def test_float64_beyond_float32_becomes_no_measurement():
    assert not decode_depth(npy(np.full((4, 6), 1e300)), camera=CAMERA).any()


def test_depth_beyond_the_limit_becomes_no_measurement():
    np.testing.assert_array_equal(
        decode_depth(npy(metres()), camera=CAMERA, max_range_m=10.0), metres() * (metres() <= 10)
    )


# By hand: with the centre at (2, 1) and f = 5, pixel (0, 1) has a ray sqrt(1 + (2/5)^2) long.
def test_range_becomes_z_by_the_length_of_the_ray():
    camera = PinholeCamera(6, 4, 5.0, 5.0, 2.0, 1.0)
    depth = decode_depth(npy(np.full((4, 6), 3.0, np.float32)), camera=camera, kind="range")
    assert depth[1, 2] == 3.0
    np.testing.assert_allclose(depth[1, 0], 3 / np.sqrt(1 + (2 / 5) ** 2), rtol=1e-6)
    np.testing.assert_allclose(depth[3, 5], 3 / np.sqrt(1 + (3 / 5) ** 2 + (2 / 5) ** 2), rtol=1e-6)


def test_range_of_a_smaller_picture_uses_its_own_rays():
    camera = PinholeCamera(12, 8, 10.0, 10.0, 4.5, 2.5)  # twice the camera above; pixel centres at whole numbers
    depth = decode_depth(npy(np.full((4, 6), 3.0, np.float32)), camera=camera, kind="range")
    np.testing.assert_allclose(depth[1, 0], 3 / np.sqrt(1 + (2 / 5) ** 2), rtol=1e-6)


def test_range_through_a_distorted_lens_uses_the_undistorted_rays():
    straight = PinholeCamera(6, 4, 5.0, 5.0, 2.5, 1.5)
    bent = PinholeCamera(6, 4, 5.0, 5.0, 2.5, 1.5, (-0.2, 0.0, 0.0, 0.0, 0.0))
    data = npy(np.full((4, 6), 3.0, np.float32))
    at_corner = [decode_depth(data, camera=camera, kind="range")[0, 0] for camera in (straight, bent)]
    assert at_corner[1] < at_corner[0]  # barrel distortion: the true ray leans farther out


# By hand: 100 px for a radian. A pixel 100 px from the centre is at 1 rad, so z is 10 m cos(1) = 5.403 m; at 157 px there is no z left.
def test_range_through_a_fisheye_lens_uses_the_angles_of_the_pixels():
    camera = PinholeCamera(401, 301, 100.0, 100.0, 200.0, 150.0, (0.0,) * 4, "kannala_brandt")
    data = npy(np.full((301, 401), 10.0, np.float32))
    depth = decode_depth(data, camera=camera, kind="range")
    np.testing.assert_allclose(depth[150, [200, 300, 350, 100]], [10, 5.403, 0.7074, 5.403], atol=1e-3)
    assert not depth[150, [0, 40, 360, 400]].any()
    assert depth[0, 200] == pytest.approx(10 * np.cos(1.5), abs=1e-3)
    stored_z = decode_depth(data, camera=camera, kind="z")
    assert (stored_z == 10).all()


# By hand: at x = 0.5 the point of the lens is 0.5 (1 - 0.2 * 0.25) = 0.475 focal lengths from the centre; the ray is sqrt(1.25) long.
def test_range_through_a_barrel_lens_uses_the_rays_before_rectification():
    camera = PinholeCamera(401, 301, 400.0, 400.0, 200.0, 150.0, (-0.2, 0.0, 0.0, 0.0))
    depth = decode_depth(npy(np.full((301, 401), 10.0, np.float32)), camera=camera, kind="range")
    assert depth[150, 390] == pytest.approx(10 / np.sqrt(1.25), rel=1e-4)
    assert depth[150, 10] == pytest.approx(10 / np.sqrt(1.25), rel=1e-4)


def test_range_through_a_lens_follows_the_size_of_the_image():
    camera = PinholeCamera(160, 120, 100.0, 100.0, 79.5, 59.5, (-0.2, 0.05, 0.001, 0.0))
    for by in (1, 2, 5):
        own = camera.scaled_to(160 * by, 120 * by)
        pixels = np.stack(np.meshgrid(np.arange(0.0, own.width, 7), np.arange(0.0, own.height, 7)), axis=-1)
        depth = decode_depth(npy(np.full((own.height, own.width), 10.0, np.float32)), camera=camera, kind="range")
        np.testing.assert_allclose(depth[::7, ::7], 10 * rays_of(own, pixels)[..., 2], rtol=1e-4)


def test_a_disparity_through_a_lens_is_refused():
    bent = PinholeCamera(6, 4, 5.0, 5.0, 2.5, 1.5, (-0.2, 0.0, 0.0, 0.0))
    with pytest.raises(RequestError, match=r"disparity is measured between rectified images.*; send") as told:
        decode_depth(npy(np.full((4, 6), 2.0, np.float32)), camera=bent, kind="disparity", baseline_m=0.4)
    assert told.value.field == "depth.kind"


def test_the_limit_is_on_the_range_where_range_is_stored():
    depth = decode_depth(npy(np.full((4, 6), 10.1, np.float32)), camera=CAMERA, kind="range", max_range_m=10.0)
    assert not depth.any()


# By hand: z = fx b / d; 5 px x 0.4 m / 2 px = 1 m.
def test_disparity_becomes_z_by_focal_length_and_baseline():
    disparity = np.full((4, 6), 2.0, np.float32)
    disparity[0] = (0, -1, np.nan, np.inf, 1e-45, 4)
    depth = decode_depth(npy(disparity), camera=CAMERA, kind="disparity", baseline_m=0.4)
    np.testing.assert_allclose(depth[1:], 1.0)
    np.testing.assert_allclose(depth[0], (0, 0, 0, 0, 0, 0.5))


def test_disparity_of_a_smaller_picture_uses_its_own_focal_length():
    camera = PinholeCamera(12, 8, 10.0, 10.0, 5.5, 3.5)
    depth = decode_depth(npy(np.full((4, 6), 2.0, np.float32)), camera=camera, kind="disparity", baseline_m=0.4)
    np.testing.assert_allclose(depth, 1.0)


def test_disparity_without_a_baseline_is_refused():
    with pytest.raises(RequestError) as caught:
        decode_depth(npy(metres()), camera=CAMERA, kind="disparity")
    assert caught.value.field == "depth.baseline_m"


@pytest.mark.parametrize(
    ("field", "value"),
    [("scale_m", 0.0), ("scale_m", float("nan")), ("max_range_m", -1.0), ("max_range_m", float("inf"))],
)
def test_numbers_that_make_no_sense_are_refused(field, value):
    with pytest.raises(RequestError) as caught:
        decode_depth(npy(metres()), camera=CAMERA, **{field: value})
    assert caught.value.field == f"depth.{field}"


@pytest.mark.parametrize("data", [encoded(".png", millimetres()), tiff(metres()), npy(metres()), sfd1(millimetres())])
@pytest.mark.parametrize("share", [0.06, 0.5, 0.95])
def test_depth_that_is_cut_off_is_refused(data, share):
    with pytest.raises(DecodeError) as caught:
        decode_depth(data[: max(8, int(share * len(data)))], camera=CAMERA)
    assert caught.value.field == "depth"


def test_pickles_are_refused_unread():
    class Bomb:
        def __reduce__(self):
            return pytest.fail, ("unpickled",)

    header = "{'descr': '|O', 'fortran_order': False, 'shape': (4, 6), }"
    with pytest.raises(UnsupportedFormatError, match="object"):
        decode_depth(npy_that_claims(header) + pickle.dumps(Bomb()), camera=CAMERA)


@pytest.mark.parametrize("dtype", ["<i4", "|u1", "<c8", "<U4", "|b1"])
def test_npy_of_another_type_is_refused(dtype):
    with pytest.raises(UnsupportedFormatError, match="float32"):
        decode_depth(npy(np.zeros((4, 6), dtype)), camera=CAMERA)


def test_npy_of_records_is_refused():
    with pytest.raises(UnsupportedFormatError):
        decode_depth(npy(np.zeros((4, 6), [("z", "<f4")])), camera=CAMERA)


def test_npy_of_a_huge_shape_is_refused_by_its_header():
    with pytest.raises(TooLargeError, match="25000000"):
        decode_depth(
            npy_that_claims("{'descr': '<f4', 'fortran_order': False, 'shape': (999999, 999999), }"), camera=CAMERA
        )


@pytest.mark.parametrize(
    "header",
    [
        "{'descr': '<f4', 'fortran_order': False, 'shape': (24,), }",
        "{'descr': '<f4', 'fortran_order': False, 'shape': (4, 6, 1), }",
        "{'descr': '<f4', 'fortran_order': False, 'shape': (-4, -6), }",
        "{'descr': '<f4', 'fortran_order': False, 'shape': (0, 6), }",
        "{'descr': '<f4', 'fortran_order': False, 'shape': (4, 7), }",
        "{'descr': '<f4', 'shape': (4, 6), }",
        "{'descr': 'nonsense', 'fortran_order': False, 'shape': (4, 6), }",
        "__import__('os')",
        "(" * 100,
        "-" * 100 + "1",
    ],
)
def test_npy_headers_that_do_not_fit_are_refused(header):
    with pytest.raises(DecodeError):
        decode_depth(npy_that_claims(header) + bytes(96), camera=CAMERA)


def test_npy_with_too_long_a_header_is_refused():
    header = "{'descr': '<f4', 'fortran_order': False, 'shape': (4, 6), }".ljust(5000)
    with pytest.raises(DecodeError):
        decode_depth(npy_that_claims(header) + bytes(96), camera=CAMERA)


def test_npy_of_version_3_is_refused():
    with pytest.raises(UnsupportedFormatError, match=r"3\.0"):
        decode_depth(npy(metres(), (3, 0)), camera=CAMERA)


def test_bytes_after_the_npy_are_refused():
    with pytest.raises(DecodeError, match="97 bytes"):
        decode_depth(npy(metres()) + b"\0", camera=CAMERA)


def tiff_that_claims(*, width=6, height=4, bits=32, sample_format=3, extra=()):
    tags = [(256, width), (257, height), (258, bits), (259, 8), (277, 1), (339, sample_format), *extra]
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in sorted(tags))
    return b"II*\0" + struct.pack("<IH", 8, len(tags)) + entries + bytes(4)


def test_a_tiff_bomb_is_refused_by_its_header(monkeypatch):
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("decoded"))
    with pytest.raises(TooLargeError, match="25000000"):
        decode_depth(tiff_that_claims(width=2**31, height=2**31), camera=CAMERA)


@pytest.mark.parametrize(
    "data",
    [
        tiff_that_claims(extra=[(322, 2**31), (323, 2**31)]),
        tiff_that_claims(extra=[(256, 9)]),
        tiff_that_claims(width=0),
        tiff_that_claims(),
        b"II*\0" + struct.pack("<I", 2**32 - 2) + bytes(9),
    ],
    ids=["huge tiles", "a tag twice", "no pixels", "no strips", "directory beyond the end"],
)
def test_a_damaged_tiff_is_refused(data):
    with pytest.raises(DecodeError):
        decode_depth(data, camera=CAMERA)


@pytest.mark.parametrize("picture", [millimetres(), np.zeros((4, 6, 3), np.float32), np.zeros((4, 6))])
def test_tiff_of_another_type_is_refused(picture):
    with pytest.raises(UnsupportedFormatError, match="1 float channel of 32"):
        decode_depth(tiff(picture), camera=CAMERA)


def test_jpeg_is_refused_as_depth():
    with pytest.raises(UnsupportedFormatError, match="JPEG"):
        decode_depth(encoded(".jpg", np.zeros((4, 6), np.uint8)), camera=CAMERA)


def test_png_beyond_the_limit_is_refused():
    with pytest.raises(TooLargeError, match="6x4"):
        decode_depth(encoded(".png", millimetres()), camera=CAMERA, limits=ImageLimits(max_pixels=23))


@pytest.mark.parametrize(
    "data",
    [
        sfd1(millimetres(), width=7),
        sfd1(millimetres(), content_size=False),
        sfd1(millimetres()) + b"more",
        lz4_sfd1(millimetres(), width=7),
        lz4_sfd1(millimetres(), width=5),
        lz4_sfd1(millimetres()) + b"more",
        lz4_sfd1(millimetres())[:-5],
        lz4_sfd1(millimetres())[:30],
        b"SFD1" + struct.pack("<II", 6, 4) + b"\x04\x22\x4d\x18",
        b"SFD1" + struct.pack("<II", 6, 4) + b"no zstd",
        b"SFD1" + bytes(8),
        b"SFD1",
    ],
)
def test_a_damaged_raw16_is_refused(data):
    with pytest.raises(DecodeError):
        decode_depth(data, camera=CAMERA)


@pytest.mark.parametrize("codec", ["zstd", "lz4"])
def test_written_values_are_read(codec):
    values = np.random.default_rng(1).integers(0, 2**16, (37, 53), np.uint16)
    camera = PinholeCamera(53, 37, 30.0, 30.0, 26.0, 18.0)
    np.testing.assert_array_equal(decode_depth(write_raw16(values, codec), camera=camera, scale_m=1.0), values)


def test_an_lz4_frame_that_does_not_say_how_long_it_is_is_read_no_further_than_it_should():
    endless = lz4_sfd1(np.zeros((4000, 4000), np.uint16), store_size=False)
    data = b"SFD1" + struct.pack("<II", 6, 4) + endless[12:]
    with pytest.raises(DecodeError, match="49 bytes, but 6x4 pixels need 48"):
        decode_depth(data, camera=CAMERA)


def test_a_raw16_bomb_is_refused_by_its_header():
    with pytest.raises(TooLargeError):
        decode_depth(sfd1(millimetres(), width=2**31, height=2**31), camera=CAMERA)


@given(
    st.sampled_from([encoded(".png", millimetres()), tiff(metres()), npy(metres()), sfd1(millimetres())]),
    st.lists(st.tuples(st.integers(0, 300), st.integers(0, 255)), min_size=1, max_size=6),
)
def test_damaged_bytes_give_a_depth_or_an_error_of_ours(data, changes):
    damaged = bytearray(data)
    for at, value in changes:
        damaged[at % len(damaged)] = value
    with contextlib.suppress(StreetfixError):
        depth = decode_depth(bytes(damaged), camera=CAMERA, limits=ImageLimits(max_pixels=10_000))
        assert np.isfinite(depth).all()
        assert (depth >= 0).all()


@pytest.mark.parametrize(
    ("stored", "encoding", "scale_m"),
    [
        ("uint16", None, 0.001),
        ("uint32", "carla", 1000 / (2**24 - 1)),
        ("float32", "auto", 1.0),
        ("float32", "compressed_depth", 1.0),
    ],
)
def test_the_scale_without_a_request_for_one_follows_from_the_stored_numbers(stored, encoding, scale_m):
    assert default_scale_m(np.dtype(stored), encoding) == scale_m
