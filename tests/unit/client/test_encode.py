from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from service.client.encode import FARTHEST_M, encode_depth, encode_rgb
from service.errors import RequestError
from service.geometry.camera import PinholeCamera
from service.imaging.decode import decode_depth, decode_rgb

RGB = np.random.default_rng(0).integers(0, 256, (6, 8, 3)).astype(np.uint8)


def read(depth: Any, **how: Any) -> Any:
    """Decode a depth image as the service does, metres."""
    encoded = encode_depth(depth, **how)
    height, width = depth.shape
    camera = PinholeCamera(width, height, 10.0, 10.0, 0.0, 0.0)
    return decode_depth(encoded.data, camera=camera, scale_m=encoded.scale_m)


def test_png_loses_nothing() -> None:
    np.testing.assert_array_equal(decode_rgb(encode_rgb(RGB, quality=None)), RGB)


def test_jpeg_loses_little_and_keeps_the_order_of_colours() -> None:
    red = np.zeros((16, 16, 3), np.uint8)
    red[..., 0] = 200
    assert np.abs(decode_rgb(encode_rgb(red)).astype(int) - red).max() <= 3


@pytest.mark.parametrize("quality", [50, 90, 95])
def test_a_jpeg_has_the_pixels_that_opencv_would_write(quality: int) -> None:
    rgb = cv2.resize(RGB, (80, 60), interpolation=cv2.INTER_CUBIC).astype(np.uint8)
    bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
    written = cv2.imencode(".jpg", bgr, (cv2.IMWRITE_JPEG_QUALITY, quality))[1].tobytes()
    np.testing.assert_array_equal(decode_rgb(encode_rgb(rgb, quality=quality)), decode_rgb(written))


def test_a_slice_of_another_picture_is_sent_as_it_looks() -> None:
    np.testing.assert_array_equal(decode_rgb(encode_rgb(RGB[::2, ::-1], quality=None)), RGB[::2, ::-1])


@pytest.mark.parametrize(
    "picture", [RGB[..., 0], RGB.astype(np.float32), RGB[:0], np.zeros((4, 4, 4), np.uint8), [[1]], None]
)
def test_an_invalid_colour_image_is_named(picture: Any) -> None:
    with pytest.raises(RequestError, match=r"rgb: must be uint8 \(H, W, 3\), not .*; pass such an array") as caught:
        encode_rgb(picture)
    assert caught.value.field == "rgb"


@pytest.mark.parametrize("quality", [0, 101, -1])
def test_an_invalid_quality_is_refused(quality: int) -> None:
    with pytest.raises(RequestError, match=f"quality: {quality} "):
        encode_rgb(RGB, quality=quality)


@pytest.mark.parametrize("order", ["<", ">"])
def test_millimetres_arrive_as_they_are_in_either_byte_order(order: str) -> None:
    values = np.array([[0, 1, 1500], [65535, 2, 3]], f"{order}u2")
    np.testing.assert_allclose(read(values), values * 0.001, rtol=1e-6)


def test_integers_of_another_scale_keep_it() -> None:
    encoded = encode_depth(np.array([[5000]], np.uint16), scale_m=1 / 5000)
    assert encoded.scale_m == 1 / 5000


def test_metres_up_to_65_are_sent_in_millimetres() -> None:
    assert encode_depth(np.array([[65.535]], np.float32)).scale_m == 0.001


@pytest.mark.parametrize(("farthest_m", "step_m"), [(66.0, 0.002), (131.07, 0.002), (200.0, 0.004), (655.35, 0.010)])
def test_farther_measurements_take_the_finest_step_that_holds_them(farthest_m: float, step_m: float) -> None:
    assert encode_depth(np.array([[1.0, farthest_m]], np.float32)).scale_m == pytest.approx(step_m)


def test_unmeasured_pixels_stay_unmeasured() -> None:
    depth = np.array([[np.nan, np.inf, -np.inf, -1.0, 0.0, FARTHEST_M + 1, 2.0]], np.float32)
    np.testing.assert_allclose(read(depth), [[0, 0, 0, 0, 0, 0, 2.0]])


def test_a_scale_of_ones_own_sends_floating_values_untouched() -> None:
    disparity = np.array([[12.3456]], np.float32)
    np.testing.assert_allclose(read(disparity, scale_m=2.0), 2.0 * disparity, rtol=1e-6)


@given(arrays(np.float32, (3, 4), elements=st.floats(0.0009765625, 650.0, width=32)))
def test_no_measurement_is_off_by_more_than_half_a_step(depth: Any) -> None:
    step_m = encode_depth(depth).scale_m
    assert step_m <= 0.010000001
    assert np.abs(read(depth) - depth).max() <= step_m / 2 + 1e-4


@pytest.mark.parametrize(
    "depth", [RGB, np.zeros((2, 2), np.int32), np.zeros((0, 2), np.float32), np.zeros(4, np.float32), 3.0]
)
def test_an_invalid_depth_image_is_named(depth: Any) -> None:
    with pytest.raises(
        RequestError, match=r"depth: must be a float or uint16 array \(H, W\), not .*; pass metres"
    ) as caught:
        encode_depth(depth)
    assert caught.value.field == "depth"


@pytest.mark.parametrize("scale_m", [0.0, -1.0, float("nan"), float("inf")])
def test_an_invalid_scale_is_refused(scale_m: float) -> None:
    with pytest.raises(RequestError, match=r"depth_scale_m: .* is not a valid scale"):
        encode_depth(np.ones((2, 2), np.float32), scale_m=scale_m)


def test_millimetres_given_as_metres_are_refused_with_the_scale() -> None:
    millimetres = np.array([[4000.0, 5000.0, 9000.0, 0.0, np.nan]], np.float32)
    with pytest.raises(RequestError) as caught:
        encode_depth(millimetres)
    assert caught.value.message == (
        "depth: the median is 5000 m, which looks like millimetres; pass depth_scale_m=0.001, or divide by 1000"
    )
    assert caught.value.field == "depth"
    np.testing.assert_allclose(read(millimetres[:, :3], scale_m=0.001), [[4.0, 5.0, 9.0]])


def test_a_sky_at_a_far_plane_is_left_out() -> None:
    np.testing.assert_allclose(read(np.array([[1000.0, 1000.0, 1000.0, 8.0]], np.float32)), [[0, 0, 0, 8.0]])
