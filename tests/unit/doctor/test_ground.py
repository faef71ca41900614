import numpy as np
import pytest

from service.doctor.ground import Ground, check_ground, ground_of
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import R_BODY_OPTICAL, rotation_y
from service.imaging.level import GivenHeight

CAMERA = PinholeCamera(160, 120, 80.0, 80.0, 79.5, 59.5)


def plane(height_m, pitch_deg=0.0):
    """Return z of an infinite ground below a camera that is pitched down; 0 above the horizon and beyond 60 m."""
    R = rotation_y(np.deg2rad(pitch_deg)) @ R_BODY_OPTICAL
    down = -(CAMERA.rays_of_pixels() @ R.T)[..., 2]
    z = np.where(down > 1e-6, height_m / np.maximum(down, 1e-6), 0.0)
    return np.where(z < 60, z, 0.0).astype(np.float32)


@pytest.mark.parametrize("height_m", [0.3, 0.7, 1.5, 2.2, 3.5])
def test_a_height_that_the_service_finds_is_ok(height_m):
    found = ground_of(plane(height_m), CAMERA, None)
    assert found.height_m == pytest.approx(height_m, abs=0.1)
    assert found.share > 0.9
    told = check_ground(found)
    assert told.level == "ok"
    assert ("if the camera is not mounted so" in told.remedy) == (height_m in (0.3, 3.5))


def test_a_height_that_the_service_does_not_find_is_a_warning_until_it_is_sent():
    told = check_ground(ground_of(plane(5.0), CAMERA, None))
    assert (told.level, float(told.text.split()[0])) == ("warning", pytest.approx(5.0, abs=0.3))
    assert "finds heights from 0.15 to 4 m: send camera.height_m" in told.remedy
    assert check_ground(ground_of(plane(5.0), CAMERA, None, GivenHeight(5.1, 0.1))).level == "ok"


def test_a_given_height_that_the_image_contradicts_is_a_warning():
    told = check_ground(ground_of(plane(1.5), CAMERA, None, GivenHeight(0.5, 0.02)))
    assert (told.level, "but the request gives 0.5 m" in told.text) == ("warning", True)


@pytest.mark.parametrize(("pitch_deg", "level"), [(5.0, "ok"), (-4.0, "ok"), (24.0, "warning")])
def test_the_pitch_is_found_without_gravity(pitch_deg, level):
    found = ground_of(plane(1.5, pitch_deg), CAMERA, None)
    assert found.pitch_deg == pytest.approx(pitch_deg, abs=1.5)
    assert found.roll_deg == pytest.approx(0.0, abs=1.0)
    assert check_ground(found).level == level


def test_gravity_is_believed():
    pitch = np.deg2rad(24.0)
    found = ground_of(plane(1.5, 24.0), CAMERA, np.array([0.0, np.cos(pitch), np.sin(pitch)]))
    assert found.pitch_deg == pytest.approx(24.0, abs=0.5)
    assert found.found_by_service_m == pytest.approx(1.5, abs=0.05)


def test_a_wall_shows_no_ground():
    found = check_ground(ground_of(np.full((120, 160), 5.0, np.float32), CAMERA, None))
    assert (found.level, found.text.startswith("no ground is visible")) == ("warning", True)


def test_a_plane_that_the_service_does_not_accept_as_ground_is_a_warning():
    z = plane(1.5)
    z[70:, :20] = plane(2.5)[70:, :20]  # a pit: too many points lie below the plane for the service
    found = ground_of(z, CAMERA, None)
    assert (found.origin, found.share > 0.8) == ("assumed", True)
    assert found.height_m == pytest.approx(found.found_by_service_m)
    told = check_ground(found)
    assert (told.level, "assumes 1.50 m" in told.text) == ("warning", True)
    assert "send camera.height_m" in told.remedy


def test_no_depth_shows_no_ground():
    assert ground_of(np.zeros((120, 160), np.float32), CAMERA, None).share == 0.0


def ground(**changed):
    given = {"share": 0.5, "height_m": 1.5, "pitch_deg": 1.0, "roll_deg": 0.0, "found_by_service_m": 1.5}
    return Ground(**(given | changed))


@pytest.mark.parametrize(
    ("changed", "text", "remedy"),
    [
        (
            {"share": 0.05},
            "no ground is visible: 5% of the pixels",
            "let the image show the ground, and send camera.height_m",
        ),
        (
            {"share": 0.05, "origin": "given", "given_m": 0.4},
            "no ground is visible",
            "level camera 0.4 m above the ground",
        ),
        (
            {"height_m": 0.5, "found_by_service_m": 1.5, "origin": "assumed"},
            "but the service does not accept this plane as ground and assumes 1.50 m",
            "send camera.height_m and gravity",
        ),
        (
            {"height_m": 0.1, "found_by_service_m": 0.15},
            "0.10 m above the ground",
            "send camera.height_m; if the camera is not mounted so",
        ),
        ({"height_m": 4.5}, "4.50 m above the ground", "depth.scale_m or fy is wrong"),
        ({"pitch_deg": -16.0}, "16 degrees up", "send gravity"),
        ({"roll_deg": 20.0}, "rolled by 20 degrees", "send gravity"),
    ],
)
def test_unusual_values_are_a_warning(changed, text, remedy):
    found = check_ground(ground(**changed))
    assert found.level == "warning"
    assert text in found.text
    assert remedy in found.remedy


def test_usual_values_are_ok():
    assert check_ground(ground()).level == "ok"
