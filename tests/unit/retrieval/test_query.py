import cv2
import numpy as np
import pytest

from service.errors import ImageSizeError, RequestError
from service.geometry.camera import PinholeCamera
from service.imaging.decode import decode_rgb
from service.imaging.raw16 import write_raw16
from service.imaging.rectify import rectification_of
from service.imaging.resample import finest_rad
from service.imaging.view_grid import ViewGrid
from service.retrieval.query import DepthFormat, Query, decoded_query


def test_the_size_error_of_a_reduced_jpeg_names_the_size_that_was_sent():
    grid, camera = ViewGrid(), PinholeCamera(640, 480, 500.0, 500.0, 319.5, 239.5)
    rgb = cv2.imencode(".jpg", np.zeros((375, 1242, 3), np.uint8))[1].tobytes()
    reduced = decode_rgb(rgb, camera=camera, finest_rad=finest_rad(grid))
    assert reduced.shape[1] < 1242
    with pytest.raises(ImageSizeError, match="`rgb` has 1242x375 pixels, but the camera has 640x480") as caught:
        decoded_query(rgb, write_raw16(np.full((480, 640), 5000, np.uint16)), camera, DepthFormat(), grid=grid)
    assert caught.value.field == "rgb"


def test_a_query_rectifies_its_images_and_refuses_distorted_ones():
    camera = PinholeCamera(64, 48, 32.0, 32.0, 31.5, 23.5, (0.0,) * 4, "kannala_brandt")
    rgb, depth_m = np.full((48, 64, 3), 9, np.uint8), np.full((48, 64), 3, np.float32)
    query = Query.of_images(rgb, depth_m, camera, baseline_m=0.1)
    pinhole = rectification_of(camera).camera
    assert query.camera == pinhole
    assert query.depth_m.shape == (pinhole.height, pinhole.width)
    assert query.focal_baseline_px_m == pytest.approx(0.1 * pinhole.fx)
    with pytest.raises(RequestError, match=r"camera has distortion; make the query by Query\.of_images"):
        Query(rgb=rgb, depth_m=depth_m, camera=camera)


def test_a_query_without_distortion_has_its_images_as_they_are():
    camera = PinholeCamera(64, 48, 32.0, 32.0, 31.5, 23.5)
    rgb, depth_m = np.full((48, 64, 3), 9, np.uint8), np.full((48, 64), 3, np.float32)
    query = Query.of_images(rgb, depth_m, camera)
    assert query.rgb is rgb
    assert query.depth_m is depth_m
    assert (query.camera, query.observed, query.baseline_m) == (camera, None, None)


def test_the_rig_of_a_query_has_the_rectified_camera_and_what_the_request_states_of_the_depth():
    lens = PinholeCamera(64, 48, 32.0, 32.0, 31.5, 23.5, (0.0,) * 4, "kannala_brandt")
    rgb = cv2.imencode(".jpg", np.full((48, 64, 3), 90, np.uint8))[1].tobytes()
    depth = write_raw16(np.full((48, 64), 5000, np.uint16))
    stated = DepthFormat(baseline_m=0.1, max_range_m=20.0)
    rig = decoded_query(rgb, depth, lens, stated, grid=ViewGrid()).rig
    pinhole = rectification_of(lens).camera
    assert (rig.width, rig.height, rig.fx, rig.cx) == (pinhole.width, pinhole.height, pinhole.fx, pinhole.cx)
    assert (rig.baseline_m, rig.max_range_m) == (0.1, 20.0)
    silent = decoded_query(rgb, depth, lens, DepthFormat(), grid=ViewGrid()).rig
    assert (silent.baseline_m, silent.max_range_m) == (None, None)


def test_a_reduced_jpeg_of_a_lens_is_rectified_at_its_own_size():
    grid, camera = ViewGrid(), PinholeCamera(1280, 960, 700.0, 700.0, 639.5, 479.5, (-0.2, 0.05, 0.0, 0.0))
    rgb = cv2.imencode(".jpg", np.full((960, 1280, 3), 90, np.uint8))[1].tobytes()
    query = decoded_query(rgb, write_raw16(np.full((480, 640), 5000, np.uint16)), camera, DepthFormat(), grid=grid)
    pinhole = rectification_of(camera).camera
    assert query.camera == pinhole
    assert query.rgb.shape[:2] == (round(pinhole.height / 2), round(pinhole.width / 2))
    assert query.depth_m.shape == (round(pinhole.height / 2), round(pinhole.width / 2))


def test_a_wrong_lens_is_refused_before_the_images_are_read():
    camera = PinholeCamera(64, 48, 32.0, 32.0, 31.5, 23.5, (-0.3, 0.0, 0.0, 0.0))
    with pytest.raises(RequestError) as caught:
        decoded_query(b"no image", b"", camera, DepthFormat(), grid=ViewGrid())
    assert caught.value.field == "camera.distortion"
