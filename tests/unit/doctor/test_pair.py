import io
import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from service.contract.schema import LocalizeRequest
from service.doctor import pair as module
from service.doctor.pair import check_depth_unit, check_images, check_measured_share, encoded_of


def npy(values):
    stream = io.BytesIO()
    np.save(stream, values)
    return stream.getvalue()


@pytest.fixture
def encoded(parts_of):
    """Return the valid pair: 64 x 48 pixels, float metres, 4 to 15 m away."""

    def make(depth=None, **changed):
        parts = parts_of(**changed)
        request = LocalizeRequest.model_validate(json.loads(parts["request"]))
        return encoded_of(request, parts["rgb"], parts["depth"] if depth is None else depth)

    return make


@pytest.fixture
def depth_m(pictures):
    return pictures[1]


def pair_of(query):
    told, pair = check_images(query)
    assert told.level == "ok"
    return pair


def test_a_good_pair_is_ok(encoded, depth_m):
    told, pair = check_images(encoded())
    assert (told.level, told.text) == ("ok", "colour 64x48, depth 64x48 of float32, camera 64x48")
    assert pair is not None
    assert (pair.is_float, pair.scale_m) == (True, 1.0)
    unit, same = check_depth_unit(pair)
    assert (unit.level, same) == ("ok", pair)
    assert check_measured_share(pair).text == "100% of the pixels have a depth"


LENS = {"width": 64, "height": 48, "fx": 32, "fy": 32, "cx": 31.5, "cy": 23.5, "distortion": [-0.3, 0.1, 0, 0]}


def test_a_wrong_distortion_does_not_keep_the_images_from_being_checked(encoded):
    """This radius stops growing before the corners. The check of the distortion tells."""
    query = encoded(camera=LENS | {"distortion": [-0.3, 0, 0, 0]})
    assert check_images(query)[0].level == "ok"
    assert not query.camera.is_distorted


def test_images_of_a_lens_are_rectified_for_the_checks_of_the_ground(encoded):
    pair = pair_of(encoded(camera=LENS))
    assert pair.rgb.shape == (48, 64, 3)
    flat = pair.rectified()
    assert not flat.camera.is_distorted
    assert flat.observed is not None
    assert flat.depth_m.shape == (flat.camera.height, flat.camera.width)
    assert pair_of(encoded()).rectified().camera == encoded().camera


def test_a_damaged_image_is_a_problem_with_the_remedy_of_the_service(encoded):
    told, pair = check_images(encoded(depth=b"\x89PNG\r\n\x1a\n"))
    assert (told.level, pair, told.remedy) == ("problem", None, "send the whole file unchanged.")


def test_swapped_width_and_height_of_the_camera_are_named(encoded):
    camera = {"width": 48, "height": 64, "fx": 32, "fy": 32, "cx": 23.5, "cy": 31.5}
    told, pair = check_images(encoded(camera=camera))
    assert (told.level, pair) == ("problem", None)
    assert told.text == (
        "width and height of the camera file are swapped, or both images are rotated (colour 64x48, depth 64x48, camera 48x64)"
    )


def test_one_image_that_is_rotated_is_named(encoded, depth_m):
    told, _ = check_images(encoded(depth=npy(np.ascontiguousarray(depth_m.T))))
    assert told.text.startswith("width and height of the depth image are swapped: it is rotated")
    assert told.remedy == "rotate the depth image by 90 degrees"


def test_a_cropped_image_gets_the_message_of_the_service(encoded, depth_m):
    told, _ = check_images(encoded(depth=npy(depth_m[:40])))
    assert "has 64x40 pixels, but the camera has 64x48, so the aspect ratios differ" in told.text


def test_millimetres_in_floats_are_named_and_tried(encoded, depth_m):
    pair = pair_of(encoded(depth=npy(depth_m * 1000)))
    told, tried = check_depth_unit(pair)
    median_m = float(np.median(depth_m))
    assert told.level == "problem"
    assert told.text.endswith("with depth.scale_m 1: the floating-point depth looks like millimetres")
    assert told.remedy.startswith(f"set depth.scale_m to 0.001: the median is then {median_m:.3g}")
    assert (tried.scale_m, tried.encoded.scale_m) == (0.001, 0.001)
    np.testing.assert_allclose(tried.depth_m, depth_m, rtol=1e-5)


def test_the_default_of_floats_is_metres_and_that_of_integers_millimetres(encoded, depth_m):
    floats = pair_of(replace(encoded(), scale_m=None))
    assert floats.scale_m == 1.0
    integers = cv2.imencode(".png", np.round(depth_m * 1000).astype(np.uint16))[1].tobytes()
    pair = pair_of(replace(encoded(depth=integers), scale_m=None))
    assert (pair.is_float, pair.scale_m) == (False, 0.001)
    assert check_depth_unit(pair)[0].level == "ok"
    told, tried = check_depth_unit(pair_of(replace(encoded(depth=integers), scale_m=1.0)))
    assert told.text.endswith(": the stored depth looks like millimetres")
    assert tried.scale_m == 0.001


def test_metres_taken_for_millimetres_are_named(encoded, depth_m):
    told, tried = check_depth_unit(pair_of(replace(encoded(), scale_m=0.001)))
    assert (told.level, tried.scale_m) == ("problem", 1.0)
    assert told.text.endswith(": the stored depth looks like metres")


def test_a_limit_of_the_range_does_not_hide_the_unit(encoded, depth_m):
    """With depths times 1000, all pixels are beyond 80 m."""
    pair = pair_of(replace(encoded(depth=npy(depth_m * 1000)), max_range_m=80.0))
    assert not pair.depth_m.any()
    told, tried = check_depth_unit(pair)
    assert told.level == "problem"
    assert tried.depth_m.any()


def test_a_depth_that_no_unit_explains_is_a_warning(encoded, depth_m):
    """The depth is 0.25 m. A thousandth is 0.25 mm, and 1000 times is 250 m."""
    pair = pair_of(encoded(depth=npy(np.full((48, 64), 0.25, np.float32))))
    told, same = check_depth_unit(pair)
    assert (told.level, same) == ("warning", pair)
    assert told.text == "the median depth is 0.25 m, but usual values are 0.3 to 60 m"


def test_a_disparity_is_tried_in_its_own_unit(encoded, depth_m):
    """z = fx baseline / disparity: 32 px x 0.5 m / 2 px = 8 m. In thousandths of a pixel, the scale 1 gives 8 mm."""
    stored = npy(np.full((48, 64), 2000.0, np.float32))
    query = replace(encoded(depth=stored), depth_kind="disparity", baseline_m=0.5, scale_m=1.0)
    told, tried = check_depth_unit(pair_of(query))
    assert told.text == "the median depth is 0.008 m with depth.scale_m 1"
    assert told.remedy.startswith("set depth.scale_m to 0.001: the median is then 8 m")
    assert tried.scale_m == 0.001


def test_no_depth_is_a_problem(encoded):
    pair = pair_of(encoded(depth=npy(np.zeros((48, 64), np.float32))))
    assert check_depth_unit(pair)[0].level == "problem"
    assert check_measured_share(pair).level == "problem"


@pytest.mark.parametrize(("rows", "level"), [(5, "ok"), (4, "warning")])
def test_a_tenth_of_the_pixels_must_have_a_depth(encoded, rows, level):
    """5 of 48 rows are 10.4 %, 4 rows are 8.3 %."""
    depth_m = np.zeros((48, 64), np.float32)
    depth_m[:rows] = 5.0
    assert check_measured_share(pair_of(encoded(depth=npy(depth_m)))).level == level


def test_numbers_are_printed_without_powers_of_ten():
    assert [module._plain(number) for number in (20123.4, 8.0, 0.00699)] == ["20100", "8", "0.00699"]
