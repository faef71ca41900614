import cv2
import numpy as np
import pytest

from model_training.importing.rectify import rectified
from service.geometry.camera import PinholeCamera

SIZE = (120, 160)
PLUMB_BOB = (-0.28, 0.09, 0.001, -0.002, 0.01)
FISHEYE = (-0.05, 0.02, -0.01, 0.003)


def camera_of(distortion, model="brown_conrady"):
    return PinholeCamera(SIZE[1], SIZE[0], 110.0, 112.0, 80.5, 58.0, distortion, model)


def project(points, camera):
    if camera.distortion_model == "kannala_brandt":
        found, _ = cv2.fisheye.projectPoints(
            points.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), camera.matrix, np.array(camera.distortion)
        )
    else:
        found, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.matrix, np.array(camera.distortion))
    return found.reshape(-1, 2)


@pytest.mark.parametrize("camera", [camera_of(PLUMB_BOB), camera_of(FISHEYE, "kannala_brandt")])
def test_distorted_pixels_are_rectified_to_a_pinhole(picture_at, camera):
    """Grey levels of the recorded image are its pixel coordinates. So the rectified image shows the source of each pixel."""
    v, u = np.mgrid[0 : SIZE[0], 0 : SIZE[1]]
    rgb = np.stack([u, v, np.full(SIZE, 7)], axis=-1).astype(np.uint8)
    flat = rectified(picture_at(0, rgb=rgb, camera=camera, depth=None))
    pixels = np.stack(np.meshgrid(np.arange(30, 130, 9), np.arange(25, 95, 9)), axis=-1).reshape(-1, 2)
    rays = np.c_[(pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy], np.ones(len(pixels))]
    expected = project(rays, camera)
    found = flat.rgb[pixels[:, 1], pixels[:, 0], :2].astype(float)
    assert np.abs(expected - pixels).max() > 1.5  # the lens does bend
    np.testing.assert_allclose(found, expected, atol=0.75)  # whole grey levels
    assert not flat.camera.is_distorted
    assert flat.camera.matrix.tolist() == camera.matrix.tolist()


@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
def test_depth_is_never_mixed_between_two_surfaces(picture_at, dtype):
    depth = np.where(np.arange(SIZE[1]) < 80, 2, 9).astype(dtype)[None].repeat(SIZE[0], 0)
    picture = picture_at(0, rgb=np.zeros((*SIZE, 3), np.uint8), camera=camera_of(PLUMB_BOB), depth=depth)
    flat = rectified(picture)
    assert flat.depth is not None
    assert flat.depth.dtype == dtype
    assert set(np.unique(flat.depth)) <= {0, 2, 9}


def test_a_rectified_picture_is_no_longer_its_file_and_a_straight_one_stays(picture_at, tmp_path):
    file = tmp_path / "0.png"
    bent = picture_at(0, rgb=np.zeros((*SIZE, 3), np.uint8), camera=camera_of(PLUMB_BOB), depth=None, file=file)
    assert rectified(bent).file is None
    straight = picture_at(0, camera=PinholeCamera(8, 6, 8.0, 8.0, 3.5, 2.5, (0.0, 0.0, 0.0, 0.0)), file=file)
    assert rectified(straight) is straight
