from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.geometry.camera import PinholeCamera
from service.geometry.rigid import R_BODY_OPTICAL, transform_from
from service.registration.visibility import DiscSettings, SurfelRaycaster
from service.scoring.photometry import (
    PhotometrySettings,
    agreement_of_brightness,
    grey_of,
    seen_by_lens,
    squared_correlation,
)

SETTINGS = PhotometrySettings(patch=2, flat=0.0)
CAMERA = PinholeCamera(96, 72, 60.0, 60.0, 47.5, 35.5)
TRUE = transform_from(R_BODY_OPTICAL, np.array([0.0, 0.0, 1.5]))
PATCHES = PhotometrySettings()


def picture(rows):
    return np.array(rows, np.float32)


def test_a_patch_by_hand():
    """(0, 1, 2, 5) minus its mean is (-2, -1, 0, 3), (1, 0, 1, 2) is (0, -1, 0, 1): 4 squared over 14 times 2."""
    one, other = picture([[0, 1], [2, 5]]), picture([[1, 0], [1, 2]])
    assert squared_correlation(one, other, SETTINGS) == pytest.approx(16 / 28)


def test_unknown_pixels_do_not_count():
    """For (1, 2, 3) and (2, 4, 9), the sum of products about the means is 7, and the squares are 2 and 26."""
    one, other = picture([[1, 2], [3, np.nan]]), picture([[2, 4], [9, 1e6]])
    assert squared_correlation(one, other, SETTINGS) == pytest.approx(49 / 52)


def test_patches_of_which_too_little_is_known_do_not_count():
    one = picture([[0, 1, 1, np.nan], [2, 5, np.nan, np.nan]])
    other = picture([[0, 1, 9, 9], [2, 5, 3, 3]])
    assert squared_correlation(one, other, SETTINGS) == pytest.approx(1.0)
    assert squared_correlation(one[:, 2:], other[:, 2:], SETTINGS) == 0.0


def test_pixels_outside_whole_patches_are_left_out():
    rng = np.random.default_rng(0)
    one, other = rng.normal(size=(2, 7, 9)).astype(np.float32)
    inner = squared_correlation(one[:6, :8], other[:6, :8], SETTINGS)
    assert squared_correlation(one, other, SETTINGS) == inner


@given(st.integers(0, 1000), st.floats(0.2, 5), st.floats(-4, 4), st.sampled_from([1, -1]))
def test_neither_scale_nor_sign_nor_level_matters(seed, scale, level, sign):
    rng = np.random.default_rng(seed)
    one, other = rng.normal(size=(2, 8, 8)).astype(np.float32)
    changed = (sign * scale * other + level).astype(np.float32)
    plain = squared_correlation(one, other, SETTINGS)
    assert 0 <= plain <= 1
    assert squared_correlation(one, changed, SETTINGS) == pytest.approx(plain, abs=2e-3)


def test_a_flat_patch_carries_no_information():
    rng = np.random.default_rng(1)
    noise = (0.001 * rng.normal(size=(8, 8))).astype(np.float32)
    assert squared_correlation(noise, noise, replace(SETTINGS, flat=0.05)) < 1e-6


def test_the_small_image_covers_the_same_area_as_its_blocks():
    """The image is black except for the last column, which fills no block."""
    rgb = np.zeros((4, 9, 3), np.uint8)
    rgb[:, 8] = 255
    camera = PinholeCamera(4, 2, 4.0, 4.0, 1.5, 0.5)
    np.testing.assert_allclose(grey_of(rgb, camera, (8 / 9, 1.0), PATCHES), np.log(8.0), rtol=1e-6)
    assert grey_of(rgb, camera, (1.0, 1.0), PATCHES)[:, -1].min() > np.log(8.0)


def test_a_small_pixel_is_seen_if_the_lens_saw_all_of_it():
    """12 x 8 pixels, of which 10 x 8 make 5 x 4 blocks. The lens did not see the first column and one pixel."""
    observed = np.ones((8, 12), np.bool_)
    observed[:, 0] = observed[5, 7] = observed[:, 10:] = False
    small = PinholeCamera(5, 4, 3.0, 3.0, 2.0, 1.5)
    expected = np.ones((4, 5), np.bool_)
    expected[:, 0] = expected[2, 3] = False
    np.testing.assert_array_equal(seen_by_lens(observed, small, (10 / 12, 1.0)), expected)


@pytest.fixture(scope="module")
def painted(scene_of):
    """Return a wall 8 m ahead with dark and bright posters, and the image of a camera in front of it."""
    cloud = scene_of(((8, -12, -2), (0, 24, 0), (0, 0, 8))).survey(per_m2=400.0)
    across, up = (cloud.unpacked(np.s_[:])["xyz"] + cloud.origin_m)[:, 1:].T
    paint = np.random.default_rng(5).uniform(0.1, 1.0, (12, 32))
    bright = paint[((up + 2) / 0.75).astype(int).clip(0, 11), ((across + 12) / 0.75).astype(int).clip(0, 31)]
    return replace(cloud, brightness=bright.astype(np.float16)), paint


def seen(paint, T_map_camera):
    rays = CAMERA.rays_of_pixels() @ T_map_camera[:3, :3].T
    surfel_of = T_map_camera[:3, 3] + rays * ((8 - T_map_camera[0, 3]) / rays[..., :1])
    row, column = ((surfel_of[..., 2] + 2) / 0.75).astype(int), ((surfel_of[..., 1] + 12) / 0.75).astype(int)
    level = np.where((row >= 0) & (row < 12), paint[row.clip(0, 11), column.clip(0, 31)], 0.5)
    return np.repeat((255 * (1.1 - level)).astype(np.uint8)[..., None], 3, axis=2)  # what reflects is dark to the eye


def told(cloud, rgb, T_map_camera):
    T = T_map_camera.copy()
    T[:3, 3] -= cloud.origin_m
    grey = grey_of(rgb, CAMERA, (1.0, 1.0), PATCHES)
    return agreement_of_brightness(cloud, SurfelRaycaster(cloud, DiscSettings()).intersect(T, CAMERA), grey, PATCHES)


@pytest.mark.parametrize("aside_m", [-3.0, -1.0, -0.5, 0.5, 1.0, 3.0])
def test_brightness_decides_along_a_wall_of_uniform_depth(painted, aside_m):
    cloud, paint = painted
    rgb, elsewhere = seen(paint, TRUE), TRUE.copy()
    elsewhere[1, 3] += aside_m
    assert told(cloud, rgb, TRUE) > 0.4
    assert told(cloud, rgb, TRUE) > 2 * told(cloud, rgb, elsewhere)


def test_a_size_of_its_own_does_not_matter(painted):
    cloud, paint = painted
    rgb = seen(paint, TRUE)
    large = cv2.resize(rgb, (3 * CAMERA.width, 3 * CAMERA.height), interpolation=cv2.INTER_NEAREST)
    assert told(cloud, large, TRUE) == pytest.approx(told(cloud, rgb, TRUE), abs=1e-6)


def test_the_sensors_unit_does_not_matter(painted):
    cloud, paint = painted
    other = replace(cloud, brightness=(cloud.brightness * np.float16(255)))
    assert told(other, seen(paint, TRUE), TRUE) == pytest.approx(told(cloud, seen(paint, TRUE), TRUE), abs=1e-3)


@pytest.mark.parametrize("brightness", [0.0, np.nan])
def test_a_map_without_brightness_scores_zero(painted, brightness):
    cloud, paint = painted
    blank = np.full(len(cloud.surfels), brightness, np.float16)
    assert told(replace(cloud, brightness=blank), seen(paint, TRUE), TRUE) == 0.0
