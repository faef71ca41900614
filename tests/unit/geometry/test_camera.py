import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.geometry.camera import PinholeCamera

CAMERA = PinholeCamera(640, 480, 320.0, 310.0, 319.5, 239.5)


def test_the_matrix_is_k():
    np.testing.assert_array_equal(CAMERA.matrix, [[320, 0, 319.5], [0, 310, 239.5], [0, 0, 1]])


@pytest.mark.parametrize(
    ("row", "column", "ray"), [(0, 0, [-319.5 / 320, -239.5 / 310, 1]), (240, 320, [0.5 / 320, 0.5 / 310, 1])]
)
def test_rays_go_through_the_centres_of_pixels(row, column, ray):
    np.testing.assert_allclose(CAMERA.rays_of_pixels()[row, column], ray)


def test_rays_project_back_to_their_pixels():
    camera = PinholeCamera(7, 5, 4.0, 3.0, 2.2, 1.9)
    pixels = camera.rays_of_pixels() @ camera.matrix.T
    u, v = np.meshgrid(np.arange(7), np.arange(5))
    np.testing.assert_allclose(pixels[..., :2], np.stack([u, v], axis=-1), atol=1e-12)


@given(st.integers(1, 8))
def test_scaling_keeps_the_rays_of_the_corners(factor):
    small = CAMERA.scaled_to(640 // factor * 2, 480 // factor * 2)

    def corner(camera, x, y):  # pixel centres are whole numbers, so the picture ends half a pixel beyond
        return (x * camera.width - 0.5 - camera.cx) / camera.fx, (y * camera.height - 0.5 - camera.cy) / camera.fy

    for x, y in ((0, 0), (1, 0), (0.3, 0.8), (1, 1)):
        np.testing.assert_allclose(corner(small, x, y), corner(CAMERA, x, y), atol=1e-12)


def test_half_a_picture_has_half_the_focal_length_and_a_shifted_centre():
    half = CAMERA.scaled_to(320, 240)
    assert (half.fx, half.fy, half.cx, half.cy) == (160.0, 155.0, 159.5, 119.5)


def test_scaling_there_and_back_changes_nothing():
    back = CAMERA.scaled_to(200, 150).scaled_to(640, 480)
    np.testing.assert_allclose((back.fx, back.fy, back.cx, back.cy), (CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy))
