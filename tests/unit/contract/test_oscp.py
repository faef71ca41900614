import base64
import math

import numpy as np
import pytest

from service.contract.oscp import GeoPoseRequest, accuracy_of, query_of
from service.errors import DecodeError, NotYetSupportedError, RequestError
from service.imaging.level import GivenHeight

RGB, DEPTH = b"a jpeg", b"a png"
PINHOLE = {"model": "PINHOLE", "modelParams": [300.0, 310.0, 320.0, 240.0]}
#: Of a camera that looks north: x east, y down, z north.
NORTH = {"x": -math.sqrt(0.5), "y": 0.0, "z": 0.0, "w": math.sqrt(0.5)}


def reading(kind, content, **changed):
    return {
        "imageFormat": kind,
        "size": [640, 480],
        "imageBytes": base64.b64encode(content).decode(),
        "params": PINHOLE,
    } | changed


def request_of(cameras=None, **changed):
    cameras = [reading("RGBA32", RGB), reading("DEPTH", DEPTH)] if cameras is None else cameras
    content = {"id": "1", "timestamp": 1.5, "type": "geopose", "sensors": [{"id": "c", "type": "camera"}]}
    return GeoPoseRequest.model_validate(
        content | {"sensorReadings": {"cameraReadings": cameras} | changed.pop("readings", {})} | changed
    )


def test_pictures_and_intrinsics_are_taken_over():
    """COLMAP counts from the corner of the first pixel, this service from its centre."""
    query = query_of(request_of(), "site")
    assert (query.rgb, query.depth, query.map_name) == (RGB, DEPTH, "site")
    camera = query.camera
    assert (camera.width, camera.height) == (640, 480)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (300, 310, 319.5, 239.5)
    assert (query.max_range_m, query.down_camera, query.prior) == (None, None, None)


@pytest.mark.parametrize(
    ("model", "numbers", "expected"),
    [
        ("SIMPLE_PINHOLE", [300, 320, 240], (300, 300, 319.5, 239.5)),
        ("simple_radial", [300, 320, 240, 0], (300, 300, 319.5, 239.5)),
        ("RADIAL", [300, 320, 240, 0, 0], (300, 300, 319.5, 239.5)),
        ("OPENCV", [300, 310, 320, 240, 0, 0, 0, 0], (300, 310, 319.5, 239.5)),
        ("FULL_OPENCV", [300, 310, 320, 240] + [0] * 8, (300, 310, 319.5, 239.5)),
    ],
)
def test_every_camera_model_is_read(model, numbers, expected):
    colour = reading("RGBA32", RGB, params={"model": model, "modelParams": numbers})
    camera = query_of(request_of([colour, reading("DEPTH", DEPTH, params=None)]), None).camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == expected


@pytest.mark.parametrize(
    ("params", "error"),
    [
        (None, RequestError),
        ({"model": "PINHOLE", "modelParams": [300, 310, 320]}, RequestError),
        ({"model": "FISHEYE", "modelParams": [1] * 4}, RequestError),
        ({"model": None, "modelParams": None}, RequestError),
        ({"model": "OPENCV_FISHEYE", "modelParams": [300, 310, 320, 240, 0.1]}, RequestError),
        ({"model": "SIMPLE_RADIAL", "modelParams": [300, 320, 240, 2000]}, RequestError),
        ({"model": "PINHOLE", "modelParams": [-300, 310, 320, 240]}, RequestError),
    ],
)
def test_intrinsics_that_make_no_sense_are_refused(params, error):
    with pytest.raises(error):
        query_of(request_of([reading("RGBA32", RGB, params=params), reading("DEPTH", DEPTH)]), None)


@pytest.mark.parametrize(
    ("model", "numbers", "distortion", "lens"),
    [
        ("SIMPLE_RADIAL", [300, 320, 240, 0.1], (0.1, 0, 0, 0), "brown_conrady"),
        ("RADIAL", [300, 320, 240, 0.1, 0.2], (0.1, 0.2, 0, 0), "brown_conrady"),
        ("OPENCV", [300, 310, 320, 240, 0.1, 0.2, 0.01, 0.02], (0.1, 0.2, 0.01, 0.02), "brown_conrady"),
        ("FULL_OPENCV", [300, 310, 320, 240, *[0.1] * 8], (0.1,) * 8, "brown_conrady"),
        ("SIMPLE_RADIAL_FISHEYE", [300, 320, 240, 0.1], (0.1, 0, 0, 0), "kannala_brandt"),
        ("RADIAL_FISHEYE", [300, 320, 240, 0.1, 0.2], (0.1, 0.2, 0, 0), "kannala_brandt"),
        ("OPENCV_FISHEYE", [300, 310, 320, 240, 0, 0, 0, 0], (0, 0, 0, 0), "kannala_brandt"),
    ],
)
def test_the_lens_of_colmaps_models_is_read(model, numbers, distortion, lens):
    params = {"model": model, "modelParams": numbers}
    depth = reading("DEPTH", DEPTH, params=params)
    camera = query_of(request_of([reading("RGBA32", RGB, params=params), depth]), None).camera
    assert (camera.distortion, camera.distortion_model) == (distortion, lens)
    assert (camera.cx, camera.cy) == (319.5, 239.5)


@pytest.mark.parametrize(
    ("model", "numbers"),
    [("PINHOLE", [300, 310, 320, 240]), ("OPENCV", [300, 310, 320, 240, 0.1, 0, 0, 0])],
)
def test_depth_of_another_lens_is_refused_not_misread(model, numbers):
    bent = {"model": "OPENCV_FISHEYE", "modelParams": [300, 310, 320, 240, 0.1, 0, 0, 0]}
    depth = reading("DEPTH", DEPTH, params={"model": model, "modelParams": numbers})
    with pytest.raises(NotYetSupportedError, match=r"its distortion differs .*; send depth .* or rectify both images"):
        query_of(request_of([reading("RGBA32", RGB, params=bent), depth]), None)


def test_a_query_without_depth_is_refused_with_the_missing_part():
    with pytest.raises(RequestError, match=r"imageFormat DEPTH.*second reading") as caught:
        query_of(request_of([reading("RGBA32", RGB)]), None)
    assert caught.value.field == "sensorReadings.cameraReadings"
    with pytest.raises(RequestError, match=r"the colour image .* is missing"):
        query_of(request_of([reading("DEPTH", DEPTH)]), None)
    with pytest.raises(RequestError, match=r"the colour image .* is missing"):
        query_of(GeoPoseRequest(), None)


@pytest.mark.parametrize(
    ("params", "size", "fits"),
    [
        (PINHOLE, [640, 480], True),
        ({"model": "SIMPLE_PINHOLE", "modelParams": [153, 160, 120]}, [320, 240], True),
        (None, None, True),
        ({"model": "PINHOLE", "modelParams": [380, 380, 320, 240]}, [640, 480], False),
        ({"model": "PINHOLE", "modelParams": [300, 310, 340, 240]}, [640, 480], False),
    ],
)
def test_depth_of_another_view_is_refused_not_misread(params, size, fits):
    request = request_of([reading("RGBA32", RGB), reading("DEPTH", DEPTH, params=params, size=size)])
    if fits:
        query_of(request, None)
        return
    with pytest.raises(NotYetSupportedError, match="registered to the colour image"):
        query_of(request, None)


def test_the_latest_readings_count():
    cameras = [reading("RGBA32", b"old"), reading("DEPTH", b"old"), reading("GRAY8", RGB), reading("DEPTH", DEPTH)]
    query = query_of(request_of(cameras), None)
    assert (query.rgb, query.depth) == (RGB, DEPTH)


def test_a_data_url_is_read_and_what_is_no_base64_is_named():
    url = "data:image/jpeg;base64," + base64.b64encode(RGB).decode()
    assert query_of(request_of([reading("RGBA32", b"", imageBytes=url), reading("DEPTH", DEPTH)]), None).rgb == RGB
    with pytest.raises(DecodeError) as caught:
        query_of(request_of([reading("RGBA32", RGB), reading("DEPTH", b"", imageBytes="@@@")]), None)
    assert caught.value.field.endswith("depth.imageBytes")


@pytest.mark.parametrize("turned", [{"mirrored": True}, {"rotation": 90}, {"rotation": -90.0, "mirrored": None}])
def test_turned_or_mirrored_pictures_are_refused_not_misread(turned):
    with pytest.raises(NotYetSupportedError):
        query_of(request_of([reading("RGBA32", RGB, imageOrientation=turned), reading("DEPTH", DEPTH)]), None)


@pytest.mark.parametrize("upright", [None, {"mirrored": False, "rotation": 0}, {"rotation": 360}, {}])
def test_upright_pictures_are_not(upright):
    query_of(request_of([reading("RGBA32", RGB, imageOrientation=upright), reading("DEPTH", DEPTH)]), None)


@pytest.mark.parametrize(
    ("felt", "down"),
    [
        ({"x": 0, "y": 9.81, "z": 0}, (0, 1, 0)),  # held upright: down is the picture's down
        ({"x": 9.81, "y": 0.001, "z": 0}, (-1, 0, 0)),  # turned to its right side up: down is the picture's left
        ({"x": 0, "y": 9.0, "z": 1.0}, (0, 0.9939, 0.1104)),  # leaning back, the lens looks down a little
    ],
)
def test_the_accelerometer_gives_the_down_direction(felt, down):
    query = query_of(request_of(readings={"accelerometerReadings": [{"x": 1, "y": 1, "z": 1}, felt]}), None)
    assert query.down_camera is not None
    np.testing.assert_allclose(query.down_camera, down, atol=2e-4)


@pytest.mark.parametrize("felt", [{}, {"x": 1, "y": None, "z": 1}, {"x": 0, "y": 0, "z": 0}])
def test_an_accelerometer_that_says_nothing_is_passed_over(felt):
    assert query_of(request_of(readings={"accelerometerReadings": [felt]}), None).down_camera is None


def test_a_satellite_fix_is_a_prior():
    fixes = [
        {"latitude": 1, "longitude": 2},
        {"latitude": 48.1, "longitude": 11.5, "accuracy": 12.0, "heading": None},
        {"latitude": None},
    ]
    query = query_of(request_of(readings={"geolocationReadings": fixes}), None)
    assert query.prior_wgs84 == (48.1, 11.5)
    assert query.prior is not None
    assert (query.prior.position_std_m, query.prior.heading_rad) == (12.0, None)


@pytest.mark.parametrize("accuracy", [0.0, -1.0, 3.4028234663852886e38, 1.7976931348623157e308, None])
def test_an_accuracy_that_is_a_structures_first_value_is_not_known(accuracy):
    """The reference clients initialise accuracies with 0, and those of earlier poses with the largest float."""
    fix = {"latitude": 48.1, "longitude": 11.5, "accuracy": accuracy}
    geopose = {"position": {"lat": 48, "lon": 11, "h": 0}, "quaternion": NORTH}
    earlier = {"geopose": geopose, "accuracy": {"position": accuracy}}
    for asked in (request_of(readings={"geolocationReadings": [fix]}), request_of(priorPoses=[earlier])):
        prior = query_of(asked, None).prior
        assert prior is not None
        assert prior.position_std_m == 20.0


def test_an_image_may_have_its_real_suffix():
    assert query_of(request_of([reading("JPG", RGB), reading("DEPTH", DEPTH)]), None).rgb == RGB


def test_an_earlier_pose_is_a_better_one_with_its_heading():
    earlier = {
        "id": "0",
        "geopose": {"position": {"lat": 48, "lon": 11, "h": 500}, "quaternion": NORTH},
        "accuracy": {"position": 0.1},
    }
    readings = {"geolocationReadings": [{"latitude": 1, "longitude": 2}]}
    query = query_of(request_of(priorPoses=[{"geopose": None}, earlier], readings=readings), None)
    assert query.prior_wgs84 == (48, 11)
    assert query.prior is not None
    assert query.prior.position_std_m == 5.0  # not 0.1: the robot has moved since
    assert query.prior.heading_rad == pytest.approx(np.pi / 2)
    assert query.prior.heading_std_rad == pytest.approx(np.deg2rad(30))


def test_accuracies_are_means_of_standard_deviations():
    found = accuracy_of(np.diag([0.01, 0.04, 0.09, *np.deg2rad([1.0, 2.0, 3.0]) ** 2]).reshape(-1).tolist())
    assert found.position == pytest.approx((0.1 + 0.2 + 0.3) / 3)
    assert found.orientation == pytest.approx(2.0)
    assert (accuracy_of(None).position, accuracy_of(None).orientation) == (None, None)


@pytest.mark.parametrize(
    ("added", "expected"),
    [
        ({}, None),
        ({"heightAboveGround": 0.3}, GivenHeight(0.3, 0.05)),
        ({"heightAboveGround": 0.3, "heightAboveGroundAccuracy": 0.02}, GivenHeight(0.3, 0.02)),
        ({"heightAboveGroundAccuracy": 0.02}, None),
    ],
)
def test_the_height_of_the_colour_camera_is_read(added, expected):
    cameras = [reading("RGBA32", RGB, params=PINHOLE | added), reading("DEPTH", DEPTH)]
    assert query_of(request_of(cameras), None).camera_height == expected
