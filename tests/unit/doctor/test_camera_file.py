import json

import pytest

from service.contract.schema import Camera
from service.doctor import camera_file

GOOD = {"width": 640, "height": 480, "fx": 320, "fy": 320, "cx": 319.5, "cy": 239.5}


def camera(**changed):
    return Camera(**(GOOD | changed))


def write(tmp_path, content):
    path = tmp_path / "camera.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def test_a_request_is_read(tmp_path):
    told, request = camera_file.check_camera_file(write(tmp_path, {"camera": GOOD, "depth": {"scale_m": 0.001}}))
    assert told.level == "ok"
    assert request is not None
    assert (request.camera.width, request.depth.scale_m) == (640, 0.001)


@pytest.mark.parametrize(
    ("content", "text", "remedy"),
    [
        ("{", "Invalid JSON", "see the schema at /openapi.json"),
        ({"camera": GOOD | {"fx": "wide"}}, "camera.fx: ", "see the schema at /openapi.json"),
        (GOOD, "camera: Field required", 'put the intrinsics under "camera": {"camera": {"width": 640, ...}}'),
    ],
)
def test_another_file_is_a_problem_that_names_the_field(tmp_path, content, text, remedy):
    told, request = camera_file.check_camera_file(write(tmp_path, content))
    assert (told.level, request, told.remedy) == ("problem", None, remedy)
    assert text in told.text
    assert str(tmp_path) in told.text


def test_a_missing_file_is_a_problem(tmp_path):
    told, request = camera_file.check_camera_file(tmp_path / "none.json")
    assert (told.level, request, told.remedy) == ("problem", None, "check --camera")


@pytest.mark.parametrize(
    ("changed", "level"),
    [({}, "ok"), ({"cx": 383.5}, "ok"), ({"cx": 390}, "warning"), ({"cy": 287.5}, "ok"), ({"cy": 180}, "warning")],
)
def test_the_principal_point_lies_within_a_tenth_of_the_centre(changed, level):
    """A tenth of 640 px is 64 px, so cx may be 319.5 +- 64. A tenth of 480 px is 48 px."""
    assert camera_file.check_principal_point(camera(**changed)).level == level


def test_intrinsics_of_an_image_of_twice_the_size_are_named():
    found = camera_file.check_principal_point(camera(cx=639.5, cy=479.5))
    assert found.text.endswith("look like those of an image of about 1280x960 px")
    assert found.remedy == "scale fx, fy, cx and cy by 0.5, or correct width and height"


@pytest.mark.parametrize(("fx", "level"), [(320, "ok"), (1190, "ok"), (1200, "warning"), (86, "ok"), (85, "warning")])
def test_the_field_of_view_is_30_to_150_degrees(fx, level):
    """320 px / tan(15 degrees) is 1194 px; 320 px / tan(75 degrees) is 85.7 px."""
    assert camera_file.check_field_of_view(camera(fx=fx)).level == level


def test_the_field_of_view_is_printed():
    assert camera_file.check_field_of_view(camera()).text == "90 degrees across and 74 degrees down"


@pytest.mark.parametrize(("fy", "level"), [(320, "ok"), (256, "ok"), (400, "ok"), (250, "warning"), (410, "warning")])
def test_focal_lengths_differ_by_a_fifth_at_most(fy, level):
    """The limit is a fifth of the larger focal length: 64 px of 320 px, 80 px of 400 px."""
    assert camera_file.check_focal_lengths(camera(fy=fy)).level == level


def test_images_without_distortion_must_be_rectified():
    for distortion in ([], [0, 0, 0, 0]):
        found = camera_file.check_distortion(camera(distortion=distortion))
        text = "none given, so both images must be rectified; the command cannot check this"
        assert (found.level, found.text) == ("ok", text)
        assert "ruler" in found.remedy


@pytest.mark.parametrize(
    ("distortion", "model"), [([-0.3, 0.1, 0, 0], "brown_conrady"), ([0, 0, 0, 0], "kannala_brandt")]
)
def test_the_service_rectifies_a_lens_if_both_images_have_it(distortion, model):
    found = camera_file.check_distortion(camera(distortion=distortion, distortion_model=model))
    assert found.level == "ok"
    assert found.text.startswith(f"{model} [")
    assert found.text.endswith("the service rectifies both images")
    assert "both images must have this lens" in found.remedy


def test_a_lens_that_cannot_be_rectified_is_a_problem_with_the_remedy():
    found = camera_file.check_distortion(camera(distortion=[-0.3, 0, 0, 0]))
    assert found.level == "problem"
    assert "not invertible over the image" in found.text
    assert found.remedy.startswith("check the order of the coefficients")
    assert camera_file.check_field_of_view(camera(distortion=[-0.3, 0, 0, 0])).level == "warning"


def test_the_field_of_view_of_a_lens_is_that_of_the_rectified_image():
    """An equidistant lens at 305.58 px for a radian: 120 and 90 degrees."""
    fisheye = camera(fx=305.58, fy=305.58, distortion=[0, 0, 0, 0], distortion_model="kannala_brandt")
    found = camera_file.check_field_of_view(fisheye)
    assert (found.level, found.text) == (
        "ok",
        "120 degrees across and 90 degrees down in the rectified image of 729x421",
    )
    narrow = camera(fx=1400, fy=1400, distortion=[0, 0, 0, 0], distortion_model="kannala_brandt")
    assert camera_file.check_field_of_view(narrow).level == "warning"
