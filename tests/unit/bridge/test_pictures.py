import array
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.bridge.pictures import camera_from, depth_from, is_rectified_by_name, rgb_from
from service.errors import RequestError
from service.geometry.camera import DistortionModel, PinholeCamera

Image = Callable[..., Any]
RGB = np.arange(2 * 3 * 3, dtype=np.uint8).reshape(2, 3, 3)
ALPHA = np.full((2, 3, 1), 9, np.uint8)


@pytest.mark.parametrize(
    ("encoding", "stored"),
    [
        ("rgb8", RGB),
        ("bgr8", RGB[..., ::-1]),
        ("rgba8", np.concatenate([RGB, ALPHA], axis=2)),
        ("bgra8", np.concatenate([RGB[..., ::-1], ALPHA], axis=2)),
    ],
)
def test_colours_are_read_in_every_order(image_of: Image, encoding: str, stored: Any) -> None:
    np.testing.assert_array_equal(rgb_from(image_of(stored, encoding), "/c"), RGB)


def test_grey_gets_three_equal_channels(image_of: Image) -> None:
    np.testing.assert_array_equal(rgb_from(image_of(RGB[..., 0], "mono8"), "/c"), RGB[..., :1].repeat(3, axis=2))


@pytest.mark.parametrize("encoding", ["16UC1", "mono16"])
@pytest.mark.parametrize(("is_bigendian", "order"), [(0, "<"), (1, ">")])
def test_integers_are_millimetres_in_either_order_of_bytes(
    image_of: Image, encoding: str, is_bigendian: int, order: str
) -> None:
    stored = np.array([[0, 1500, 65535]], f"{order}u2")
    found = depth_from(image_of(stored, encoding, is_bigendian=is_bigendian), "/d")
    np.testing.assert_allclose(found, [[0.0, 1.5, 65.535]], rtol=1e-6)
    assert found.dtype == np.float32


@pytest.mark.parametrize(("is_bigendian", "order"), [(0, "<"), (1, ">")])
def test_floats_are_metres_in_either_order_of_bytes(image_of: Image, is_bigendian: int, order: str) -> None:
    stored = np.array([[np.nan, 2.5]], f"{order}f4")
    np.testing.assert_array_equal(
        depth_from(image_of(stored, "32FC1", is_bigendian=is_bigendian), "/d"), [[np.nan, 2.5]]
    )


@given(padding=st.integers(0, 9), tail=st.integers(0, 5))
def test_the_padding_of_rows_is_no_pixel(padding: int, tail: int) -> None:
    rows = np.concatenate([RGB.reshape(2, 9), np.full((2, padding), 255, np.uint8)], axis=1)
    data = rows.tobytes() + b"x" * tail
    message = SimpleNamespace(height=2, width=3, encoding="rgb8", is_bigendian=0, step=9 + padding, data=data)
    np.testing.assert_array_equal(rgb_from(message, "/c"), RGB)


@pytest.mark.parametrize("kind", [list, lambda data: array.array("B", data), bytearray])
def test_data_may_be_what_either_library_gives(image_of: Image, kind: Callable[[bytes], Any]) -> None:
    np.testing.assert_array_equal(rgb_from(image_of(RGB, "rgb8", data=kind(RGB.tobytes())), "/c"), RGB)


@pytest.mark.parametrize(
    "wrong",
    [{"step": 8}, {"height": 3}, {"width": 4}, {"data": b""}, {"height": 0}, {"width": 0}, {"data": b"1234567"}],
)
def test_sizes_that_contradict_each_other_name_the_topic(image_of: Image, wrong: dict[str, Any]) -> None:
    with pytest.raises(RequestError, match=r"^/c: .* are not an image of .*; fix the publisher") as caught:
        rgb_from(image_of(RGB, "rgb8", **wrong), "/c")
    assert caught.value.field == "/c"


def test_other_encodings_are_refused_with_what_is_read(image_of: Image) -> None:
    with pytest.raises(RequestError, match=r"/c: the encoding 'yuv422' is not supported; publish one of rgb8, bgr8"):
        rgb_from(image_of(RGB, "yuv422"), "/c")
    with pytest.raises(RequestError, match=r"/d: the encoding 'rgb8' is not supported; .*16UC1, mono16, 32FC1"):
        depth_from(image_of(RGB, "rgb8"), "/d")


def test_the_camera_is_k_where_p_is_not_set(info_of: Image) -> None:
    assert camera_from(info_of(), "/i") == PinholeCamera(6, 4, 3.0, 3.5, 2.5, 1.5)


def test_the_camera_is_p_where_it_is_set(info_of: Image) -> None:
    p = [2.0, 0, 2.1, 0, 0, 2.2, 1.1, 0, 0, 0, 1, 0]
    assert camera_from(info_of(p=p), "/i") == PinholeCamera(6, 4, 2.0, 2.2, 2.1, 1.1)


def test_a_window_of_the_sensor_moves_the_centre(info_of: Image) -> None:
    roi = SimpleNamespace(x_offset=2, y_offset=1, width=4, height=3)
    assert camera_from(info_of(roi=roi), "/i") == PinholeCamera(4, 3, 3.0, 3.5, 0.5, 0.5)


@pytest.mark.parametrize("wrong", [{"k": [0.0] * 9}, {"width": 0}, {"height": 1}])
def test_a_camera_without_calibration_is_told(info_of: Image, wrong: dict[str, Any]) -> None:
    with pytest.raises(RequestError, match="/i: this camera is not calibrated"):
        camera_from(info_of(**wrong), "/i")


@pytest.mark.parametrize(
    ("model", "d", "lens"),
    [
        ("plumb_bob", [-0.3, 0.1, 0.0, 0.0, 0.0], "brown_conrady"),
        ("", [-0.3, 0.1, 0.0, 0.0], "brown_conrady"),
        ("rational_polynomial", [0.5, -2.6, 0.0, 0.0, 1.5, 0.38, -2.4, 1.4], "brown_conrady"),
        ("equidistant", [0.1, 0.0, 0.0, 0.0], "kannala_brandt"),
        ("equidistant", [0.0, 0.0, 0.0, 0.0], "kannala_brandt"),
    ],
)
def test_a_raw_image_has_k_and_the_lens(info_of: Image, model: str, d: list[float], lens: DistortionModel) -> None:
    p = [2.0, 0, 2.1, 0, 0, 2.2, 1.1, 0, 0, 0, 1, 0]
    message = info_of(distortion_model=model, d=d, p=p)
    assert camera_from(message, "/i") == PinholeCamera(6, 4, 3.0, 3.5, 2.5, 1.5, tuple(d), lens)
    assert camera_from(message, "/i", rectified=True) == PinholeCamera(6, 4, 2.0, 2.2, 2.1, 1.1)


def test_a_lens_without_distortion_is_a_pinhole(info_of: Image) -> None:
    p = [2.0, 0, 2.1, 0, 0, 2.2, 1.1, 0, 0, 0, 1, 0]
    for lens in ({"distortion_model": "plumb_bob", "d": [0.0] * 5}, {"distortion_model": "equidistant", "d": []}):
        assert camera_from(info_of(p=p, **lens), "/i") == PinholeCamera(6, 4, 2.0, 2.2, 2.1, 1.1)


def test_a_lens_that_the_service_does_not_know_needs_rectified_images(info_of: Image) -> None:
    message = info_of(distortion_model="omni", d=[0.1, 0.0, 0.0, 0.0])
    with pytest.raises(RequestError, match=r"/i: the distortion_model 'omni' is not known .*equidistant.*--rectified"):
        camera_from(message, "/i")
    assert camera_from(message, "/i", rectified=True).fx == 3.0


@pytest.mark.parametrize(
    ("topic", "is_rectified"),
    [
        ("/camera/image_rect_color", True),
        ("/camera/image_rect/compressed", True),
        ("/camera/image_raw", False),
        ("/rectory/image_raw/compressed", False),
    ],
)
def test_a_topics_name_says_whether_it_is_rectified(topic: str, is_rectified: bool) -> None:
    assert is_rectified_by_name(topic) == is_rectified
