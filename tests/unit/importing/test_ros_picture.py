from types import SimpleNamespace as Message

import cv2
import numpy as np
import pytest

from model_training.importing.ros_picture import baseline_of, camera_of, colour_of, depth_of

RGB = np.random.default_rng(0).integers(0, 256, (3, 5, 3), dtype=np.uint8)


def image(pixels, encoding, *, padding=0, big=False, **changed):
    pixels = np.ascontiguousarray(pixels.astype(pixels.dtype.newbyteorder(">" if big else "<")))
    rows = pixels.view(np.uint8).reshape(len(pixels), -1)
    data = np.pad(rows, ((0, 0), (0, padding)), constant_values=77)
    told = {
        "height": pixels.shape[0],
        "width": pixels.shape[1],
        "encoding": encoding,
        "is_bigendian": int(big),
        "step": data.shape[1],
        "data": data.reshape(-1),
    }
    return Message(**(told | changed))


def with_alpha(pixels):
    return np.dstack([pixels, np.full(pixels.shape[:2], 9, np.uint8)])


@pytest.mark.parametrize("padding", [0, 3])
@pytest.mark.parametrize(
    ("encoding", "pixels"),
    [
        ("rgb8", RGB),
        ("bgr8", RGB[..., ::-1]),
        ("8UC3", RGB[..., ::-1]),
        ("rgba8", with_alpha(RGB)),
        ("bgra8", with_alpha(RGB[..., ::-1])),
    ],
)
def test_every_colour_encoding_gives_the_same_picture(encoding, pixels, padding):
    np.testing.assert_array_equal(colour_of(image(pixels, encoding, padding=padding)), RGB)


def test_grey_is_repeated():
    found = colour_of(image(RGB[..., 0], "mono8", padding=1))
    np.testing.assert_array_equal(found, RGB[..., :1].repeat(3, axis=2))


def test_a_compressed_picture_is_decoded_and_a_broken_one_says_so():
    data = cv2.imencode(".png", RGB[..., ::-1])[1]
    np.testing.assert_array_equal(colour_of(Message(format="rgb8; png compressed bgr8", data=data)), RGB)
    assert str(colour_of(Message(format="jpeg", data=data[:20]))).startswith("cannot be decoded")


@pytest.mark.parametrize("padding", [0, 4])
@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize(
    ("encoding", "values"),
    [
        ("16UC1", np.array([[0, 1, 65535], [258, 3, 4]], np.uint16)),
        ("32FC1", np.array([[0, 1.5, np.inf], [np.nan, 3, 4]], np.float32)),
    ],
)
def test_depth_of_both_encodings_comes_as_it_is(encoding, values, big, padding):
    found = depth_of(image(values, encoding, padding=padding, big=big))
    np.testing.assert_array_equal(found, values)
    assert not isinstance(found, str)
    assert found.dtype == values.dtype


@pytest.mark.parametrize("reader", [colour_of, depth_of])
@pytest.mark.parametrize(
    ("changed", "why"),
    [
        ({"encoding": "bayer_rggb8"}, "unknown encoding 'bayer_rggb8' (known:"),
        ({"height": 4}, "truncated"),
        ({"step": 2}, "truncated"),
        ({"width": 0}, "is 0, or over the limit"),
        ({"height": 10**6, "width": 10**6}, "over the limit"),
    ],
)
def test_an_unreadable_image_gives_a_reason(reader, changed, why):
    good = image(RGB, "rgb8") if reader is colour_of else image(np.ones((3, 5), np.uint16), "16UC1")
    assert why in reader(Message(**(vars(good) | changed)))


def test_compressed_depth_of_another_format_is_named():
    assert depth_of(Message(format="jpeg", data=b"")) == "unknown format 'jpeg' (known: compressedDepth)"


def test_reasons_are_the_same_for_pictures_cut_off_differently():
    whole = image(RGB, "rgb8")
    reasons = {colour_of(Message(**(vars(whole) | {"data": whole.data[:n]}))) for n in (1, 20, 44)}
    assert len(reasons) == 1


def info(**changed):
    K = [100.0, 0, 50, 0, 101, 40, 0, 0, 1]
    P = [90.0, 0, 52, 0, 0, 91, 42, 0, 0, 0, 1, 0]
    told = {"width": 100, "height": 80, "k": K, "p": P, "d": [0.1, 0.0, 0.0, 0.0, 0.0], "distortion_model": "plumb_bob"}
    return Message(**(told | changed))


def known_camera(message, *, is_rectified):
    found = camera_of(message, is_rectified=is_rectified)
    assert not isinstance(found, str)
    return found


def test_a_raw_picture_has_K_and_D_and_a_rectified_one_P():
    raw = known_camera(info(), is_rectified=False)
    assert (raw.fx, raw.fy, raw.cx, raw.cy, raw.distortion[0]) == (100, 101, 50, 40, 0.1)
    assert raw.distortion_model == "brown_conrady"
    flat = known_camera(info(), is_rectified=True)
    assert (flat.fx, flat.fy, flat.cx, flat.cy, flat.distortion) == (90, 91, 52, 42, ())


def test_ros_1_writes_its_matrices_in_capitals():
    told = vars(info())
    ros_1 = Message(**{(k.upper() if len(k) == 1 else k): v for k, v in told.items()})
    assert camera_of(ros_1, is_rectified=False) == camera_of(info(), is_rectified=False)


@pytest.mark.parametrize("key", ["p", "P"])  # ROS 2, ROS 1
def test_the_baseline_is_the_shift_over_the_focal_length(key):
    projection = [90.0, 0, 52, -18.0, 0, 91, 42, 0, 0, 0, 1, 0]
    assert baseline_of(Message(**{key: projection}), "/right") == 0.2


@pytest.mark.parametrize("d", [[0.1, 0, 0, 0], [0, 0, 0, 0]])
def test_a_fisheye_is_known_by_its_model(d):
    camera = known_camera(info(distortion_model="equidistant", d=d), is_rectified=False)
    assert (camera.distortion_model, camera.distortion, camera.is_distorted) == ("kannala_brandt", tuple(d), True)
    assert not known_camera(info(distortion_model="equidistant", d=d), is_rectified=True).is_distorted


def test_a_lens_without_coefficients_is_a_pinhole():
    for model in ("plumb_bob", "equidistant"):
        assert not known_camera(info(distortion_model=model, d=[]), is_rectified=False).is_distorted


@pytest.mark.parametrize(
    ("changed", "why"),
    [
        ({"k": [0.0] * 9}, "not calibrated"),
        ({"distortion_model": "omni"}, "unknown distortion_model 'omni'"),
        ({"d": [0.1, 0.2]}, "2 coefficients"),
        ({"distortion_model": "equidistant"}, "has 5 coefficients; expected 4 finite ones"),
        ({"d": [np.nan, 1, 0, 0]}, "finite"),
    ],
)
def test_an_unusable_camera_info_gives_a_reason(changed, why):
    found = camera_of(info(**changed), is_rectified=False)
    assert isinstance(found, str)
    assert why in found
