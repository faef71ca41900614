import cv2
import numpy as np
import pytest

from service.errors import ImageSizeError
from service.geometry.camera import PinholeCamera
from service.imaging.decode import decode_rgb
from service.imaging.gather import finest_rad
from service.imaging.raw16 import write_raw16
from service.imaging.view_grid import ViewGrid
from service.retrieval.query import DepthFormat, decoded_query


def test_the_size_error_of_a_reduced_jpeg_names_the_size_that_was_sent():
    grid, camera = ViewGrid(), PinholeCamera(640, 480, 500.0, 500.0, 319.5, 239.5)
    rgb = cv2.imencode(".jpg", np.zeros((375, 1242, 3), np.uint8))[1].tobytes()
    reduced = decode_rgb(rgb, camera=camera, finest_rad=finest_rad(grid))
    assert reduced.shape[1] < 1242
    with pytest.raises(ImageSizeError, match="`rgb` has 1242x375 pixels, but the camera has 640x480") as caught:
        decoded_query(rgb, write_raw16(np.full((480, 640), 5000, np.uint16)), camera, DepthFormat(), grid=grid)
    assert caught.value.field == "rgb"
