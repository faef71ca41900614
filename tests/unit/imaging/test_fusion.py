from pathlib import Path

import cv2
import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from service.imaging.fusion import fuse, ihs_linear, picture_of

GOLDEN = Path(__file__).parents[2] / "golden" / "imaging"


def golden(name, flags=cv2.IMREAD_COLOR):
    picture = cv2.imread(str(GOLDEN / name), flags)
    assert picture is not None
    return picture


def golden_inputs():
    rgb = golden("rgb.png")[..., ::-1].copy()
    depth_m = golden("depth.png", cv2.IMREAD_UNCHANGED).astype(np.float32) / np.float32(1000)
    return rgb, depth_m


def test_depth_stands_in_the_place_of_intensity_and_colour_follows_equation_9():
    rgb = np.array([[[51, 102, 153]]], np.uint8)  # 0.2, 0.4, 0.6 of 255
    planes, intensity = fuse(rgb, np.array([[7.5]], np.float32))
    np.testing.assert_allclose(planes[:, 0, 0], (7.5, 62.4619884, 36.0624458), rtol=1e-6)
    np.testing.assert_allclose(intensity[0, 0], 255 * 1.2 / np.sqrt(3), rtol=1e-6)


def test_depth_beyond_255_is_not_clipped():
    assert fuse(np.zeros((1, 1, 3), np.uint8), np.array([[999.5]], np.float32)).planes[0, 0, 0] == 999.5


@given(arrays(np.uint8, (3, 4, 1)))
def test_fusion_of_grey_has_no_colour_planes(grey):
    fused = fuse(np.repeat(grey, 3, axis=2), np.ones((3, 4), np.float32))
    np.testing.assert_allclose(fused.planes[1:], 0, atol=1e-4)
    np.testing.assert_allclose(fused.intensity, np.sqrt(3) * grey[..., 0], rtol=1e-6)


@given(arrays(np.uint8, (2, 3, 3)), st.integers(-20, 20))
def test_brightness_does_not_change_what_is_fused(rgb, step):
    depth_m = np.ones((2, 3), np.float32)
    brighter = rgb.astype(np.float32) + np.float32(step)
    np.testing.assert_allclose(fuse(brighter, depth_m).planes, fuse(rgb, depth_m).planes, atol=1e-3)


def test_planes_of_single_points_are_those_of_the_picture():
    rgb, depth_m = golden_inputs()
    points, image = fuse(rgb.reshape(-1, 3).astype(np.float32), depth_m.reshape(-1)), fuse(rgb, depth_m)
    np.testing.assert_allclose(points.planes.reshape(3, *depth_m.shape), image.planes, atol=1e-4)
    np.testing.assert_allclose(points.intensity.reshape(depth_m.shape), image.intensity, atol=1e-4)


def test_fused_planes_are_the_golden_ones():
    expected = np.load(GOLDEN / "fused.npy", allow_pickle=False)
    np.testing.assert_allclose(fuse(*golden_inputs()).planes, expected, atol=1e-3)


def test_picture_for_people_is_the_golden_one():
    picture = picture_of(fuse(*golden_inputs()).planes, 40.0).astype(int)
    expected = golden("picture.png")[..., ::-1].astype(int)
    assert np.abs(picture - expected).max() <= 1


def test_near_is_brighter_than_far_and_unmeasured_is_black():
    depth_m = np.array([[1.0, 20.0, 100.0, 0.0]], np.float32)
    picture = picture_of(fuse(np.full((1, 4, 3), 99, np.uint8), depth_m).planes, 40.0)
    near, middle, far, nothing = picture.mean(axis=-1)[0]
    assert near > middle > far > nothing == 0


@given(arrays(np.uint8, (1, 1, 3)).filter(lambda c: int(c.max()) - int(c.min()) > 40), st.floats(0.5, 50, width=32))
def test_picture_keeps_the_hue(rgb, depth_m):
    picture = picture_of(fuse(rgb, np.full((1, 1), depth_m, np.float32)).planes, 40.0)
    hue, hue_drawn = (np.arctan2(v2, v1) for _, v1, v2 in (ihs_linear(each.astype(float)) for each in (rgb, picture)))
    assert np.abs((hue - hue_drawn + np.pi) % (2 * np.pi) - np.pi).item() < np.deg2rad(5)
