import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.native import plain
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import R_BODY_OPTICAL, rotation_x, rotation_y, rotation_z
from service.imaging import level as module
from service.imaging.level import GivenHeight, is_suspicious_height, level_camera, level_query, nominal_level

CAMERA = PinholeCamera(160, 120, 80.0, 80.0, 79.5, 59.5)
DOWN_AHEAD = np.array([0.0, 1.0, 0.0])


def tilted(*, pitch_deg=0.0, roll_deg=0.0):
    """Return R_level_camera of a camera that looks along x, pitched down and rolled."""
    return rotation_y(np.deg2rad(pitch_deg)) @ rotation_x(np.deg2rad(roll_deg)) @ R_BODY_OPTICAL


def ground_depth(R_level_camera, height_m, *, camera=CAMERA, reach_m=60.0):
    """Return z of an infinite plane ``height_m`` below the camera; 0 above the horizon."""
    down = -(camera.rays_of_pixels() @ R_level_camera.T)[..., 2]
    z = np.where(down > 1e-6, height_m / np.maximum(down, 1e-6), 0.0)
    return np.where(z < reach_m, z, 0.0).astype(np.float32)


def angle_deg(R, other):
    return np.rad2deg(np.arccos(np.clip((np.trace(R.T @ other) - 1) / 2, -1, 1)))


@pytest.mark.parametrize(("pitch_deg", "roll_deg"), [(0, 0), (3, 0), (-3, 0), (0, 4), (2, -3)])
def test_a_tilted_camera_over_a_plane_finds_its_tilt(pitch_deg, roll_deg):
    R = tilted(pitch_deg=pitch_deg, roll_deg=roll_deg)
    found = level_camera(ground_depth(R, 1.5), CAMERA, down_camera=None, nominal_height_m=1.5)
    up = found.R_level_camera @ R.T @ [0, 0, 1]
    assert np.rad2deg(np.arccos(min(1.0, up[2]))) < 0.5  # the prior of a level camera pulls a little


@pytest.mark.parametrize("height_m", [1.2, 1.5, 1.9])
def test_a_camera_over_a_plane_finds_its_height(height_m):
    R = tilted(pitch_deg=2)
    found = level_camera(ground_depth(R, height_m), CAMERA, down_camera=None, nominal_height_m=1.5)
    assert found.height_m == pytest.approx(height_m, abs=0.08)


def test_the_view_keeps_the_heading_of_the_optical_axis():
    found = level_camera(
        ground_depth(tilted(pitch_deg=3, roll_deg=4), 1.5), CAMERA, down_camera=None, nominal_height_m=1.5
    )
    axis = found.R_level_camera[:, 2]
    assert axis[1] == pytest.approx(0.0, abs=1e-9)
    assert axis[0] > 0.9


def test_without_ground_the_prior_stands():
    found = level_camera(np.zeros((120, 160), np.float32), CAMERA, down_camera=None, nominal_height_m=1.4)
    np.testing.assert_allclose(found.R_level_camera, R_BODY_OPTICAL, atol=1e-12)
    assert found.height_m == pytest.approx(1.4)


@pytest.mark.parametrize(("pitch_deg", "roll_deg"), [(25, 0), (-20, 10)])
def test_gravity_stands_in_for_a_ground_that_is_not_seen(pitch_deg, roll_deg):
    R = tilted(pitch_deg=pitch_deg, roll_deg=roll_deg)
    down = R.T @ np.array([0.0, 0.0, -9.81])
    found = level_camera(np.zeros((120, 160), np.float32), CAMERA, down_camera=down, nominal_height_m=1.5)
    np.testing.assert_allclose(found.R_level_camera @ R.T @ [0, 0, 1], [0, 0, 1], atol=1e-9)


def test_gravity_lets_a_strongly_tilted_camera_find_the_ground():
    R = tilted(pitch_deg=20, roll_deg=8)
    found = level_camera(ground_depth(R, 1.7), CAMERA, down_camera=R.T @ [0.0, 0.0, -1.0], nominal_height_m=1.5)
    assert found.height_m == pytest.approx(1.7, abs=0.05)
    assert angle_deg(found.R_level_camera, nominal_level(R.T @ np.array([0.0, 0.0, -1.0]))) < 0.3


def test_the_foot_of_a_wall_seven_metres_ahead_tilts_the_ground_by_a_degree_and_a_half_at_most():
    R = tilted(pitch_deg=2)
    depth = np.minimum(np.where(ground_depth(R, 1.5) > 0, ground_depth(R, 1.5), np.inf), 7.0).astype(np.float32)
    found = level_camera(depth, CAMERA, down_camera=None, nominal_height_m=1.5)
    up = found.R_level_camera @ R.T @ [0, 0, 1]
    assert np.rad2deg(np.arccos(min(1.0, up[2]))) < 1.5
    assert found.height_m == pytest.approx(1.5, abs=0.08)


def street_depth(kerb_m):
    """Return the depth of a road 10 m wide between raised pavements, seen from 1.5 m above its centre."""
    rays = CAMERA.rays_of_pixels()
    down, aside = np.maximum(rays[..., 1], 1e-9), np.abs(rays[..., 0])
    road, pavement = 1.5 / down, (1.5 - kerb_m) / down
    z = np.where(aside * road < 5.0, road, np.where(aside * pavement < 5.0, 5.0 / np.maximum(aside, 1e-9), pavement))
    return np.where((rays[..., 1] > 0) & (z < 40), z, 0).astype(np.float32)


def test_pavements_beside_the_road_hardly_tilt_the_ground():
    found = level_camera(street_depth(0.15), CAMERA, down_camera=None, nominal_height_m=1.5)
    assert angle_deg(found.R_level_camera, R_BODY_OPTICAL) < 0.15  # degrees; 0.33 with one band for both sides
    assert found.height_m == pytest.approx(1.5, abs=0.015)


def test_depth_of_another_size_gives_the_same_level():
    R = tilted(pitch_deg=3, roll_deg=2)
    small = CAMERA.scaled_to(80, 60)
    one = level_camera(ground_depth(R, 1.6), CAMERA, down_camera=None, nominal_height_m=1.5)
    other = level_camera(ground_depth(R, 1.6, camera=small), CAMERA, down_camera=None, nominal_height_m=1.5)
    assert angle_deg(one.R_level_camera, other.R_level_camera) < 0.2
    assert other.height_m == pytest.approx(one.height_m, abs=0.02)


def test_the_nominal_level_of_a_camera_ahead_is_the_bodys():
    np.testing.assert_allclose(nominal_level(2.0 * DOWN_AHEAD), R_BODY_OPTICAL, atol=1e-12)


def test_the_nominal_level_is_a_rotation_whose_third_row_is_up():
    down = rotation_z(0.1) @ rotation_x(-0.4) @ DOWN_AHEAD
    R = nominal_level(down)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(R[2], -down, atol=1e-12)


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    pitch_deg=st.floats(-8, 8),
    roll_deg=st.floats(-8, 8),
    noise=st.floats(0, 0.3),
    size=st.sampled_from([(120, 160), (61, 79), (30, 500), (1, 1)]),
    holes=st.floats(0, 1),
    std_m=st.floats(0.01, 1),
)
def test_the_compiled_fit_equals_numpy(seed, pitch_deg, roll_deg, noise, size, holes, std_m):
    rng = np.random.default_rng(seed)
    camera = PinholeCamera(size[1], size[0], 80.0, 80.0, size[1] / 2, size[0] / 2)
    depth_m = ground_depth(tilted(pitch_deg=pitch_deg, roll_deg=roll_deg), 1.6, camera=camera)
    depth_m *= rng.normal(1, noise, depth_m.shape).astype(np.float32)
    depth_m[rng.random(depth_m.shape) < holes] = rng.choice([0.0, np.nan, np.inf, -5.0, 1e30])
    found = module._fit_ground(depth_m, camera, R_BODY_OPTICAL, 1.5, std_m)
    expected = plain.fit_ground(depth_m, camera, R_BODY_OPTICAL, 1.5, std_m)
    np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("height_m", [0.2, 0.3, 0.45, 0.8, 1.2, 1.5, 1.7, 2.0, 2.5, 3.0, 3.6])
@pytest.mark.parametrize("pitch_deg", [-2, 2])
def test_the_height_of_a_camera_is_found_between_a_fifth_of_a_metre_and_four(height_m, pitch_deg):
    level, origin = level_query(ground_depth(tilted(pitch_deg=pitch_deg), height_m), CAMERA)
    assert origin == "estimated"
    bias_m = 0.14 if 1.5 < height_m < 2 else 0.05  # near the usual height its prior counts
    assert level.height_m == pytest.approx(height_m, abs=bias_m)
    assert level.is_ground


def test_near_the_usual_height_the_answer_is_that_of_the_usual_prior():
    depth_m = ground_depth(tilted(pitch_deg=1), 1.55)
    usual = level_camera(depth_m, CAMERA, down_camera=None, nominal_height_m=1.5)
    level, _ = level_query(depth_m, CAMERA)
    assert level.height_m == usual.height_m
    np.testing.assert_array_equal(level.R_level_camera, usual.R_level_camera)


@pytest.mark.parametrize("height_m", [0.25, 1.5, 3.5])
def test_a_given_height_is_the_prior_and_without_ground_the_result(height_m):
    nothing = np.zeros((120, 160), np.float32)
    level, origin = level_query(nothing, CAMERA, given=GivenHeight(height_m, 0.05))
    assert (level.height_m, origin) == (pytest.approx(height_m), "given")
    level, _ = level_query(ground_depth(tilted(), height_m), CAMERA, given=GivenHeight(height_m + 0.05, 0.05))
    assert height_m <= level.height_m <= height_m + 0.05
    sure, _ = level_query(ground_depth(tilted(), height_m), CAMERA, given=GivenHeight(height_m + 0.05, 1e-4))
    assert sure.height_m == pytest.approx(height_m + 0.05, abs=2e-3)


def test_without_ground_the_usual_height_is_assumed():
    level, origin = level_query(np.zeros((120, 160), np.float32), CAMERA)
    assert (level.height_m, origin) == (pytest.approx(1.5), "assumed")
    wall = np.full((120, 160), 6.0, np.float32)
    level, origin = level_query(wall, CAMERA)
    assert (level.height_m, origin) == (pytest.approx(1.5, abs=0.05), "assumed")


@pytest.mark.parametrize(
    ("height_m", "origin", "expected"),
    [
        (3.0, "estimated", True),
        (0.75, "estimated", True),
        (3.0, "given", False),
        (1.5, "estimated", False),
        (2.2, "estimated", False),
        (0.3, "estimated", False),
        (3.0, "assumed", False),
    ],
)
def test_half_and_twice_the_usual_height_are_suspicious_unless_given(height_m, origin, expected):
    assert is_suspicious_height(height_m, origin) == expected


def test_a_plane_with_points_below_it_is_no_ground():
    """The roof of a car fills the near half of the image. The ground beside it is 1.4 m lower."""
    roof, ground = ground_depth(tilted(), 0.6), ground_depth(tilted(), 2.0)
    depth_m = np.where(np.arange(160) < 60, roof, ground).astype(np.float32)
    level, origin = level_query(depth_m, CAMERA)
    assert origin == "estimated"
    assert level.height_m == pytest.approx(2.0, abs=0.05)


@pytest.mark.parametrize("pitch_deg", [8, 12, 16, 20, 24])
@pytest.mark.parametrize("height_m", [0.4, 1.0, 1.5, 2.5])
@pytest.mark.parametrize("is_given", [False, True])
def test_the_pitch_of_a_camera_that_looks_down_is_found_without_gravity(pitch_deg, height_m, is_given):
    """With a house 9 m ahead."""
    R = tilted(pitch_deg=pitch_deg)
    depth_m = ground_depth(R, height_m)
    ahead = (CAMERA.rays_of_pixels() @ R.T)[..., 0]
    house = np.where(ahead > 0, 9.0 / np.maximum(ahead, 1e-6), 0).astype(np.float32)
    depth_m = np.where((depth_m == 0) | (house < depth_m), house, depth_m)
    given = GivenHeight(height_m, 0.05) if is_given else None
    level, origin = level_query(depth_m, CAMERA, given=given)
    up = level.R_level_camera @ R.T @ [0, 0, 1]
    assert np.rad2deg(np.arccos(min(1.0, up[2]))) < 2
    assert level.height_m == pytest.approx(height_m, abs=0.1)
    assert origin == ("given" if is_given else "estimated")


def test_gravity_rules_out_other_tilts():
    """A slope that falls by 20 degrees: with gravity the camera is level, without it the slope counts as level ground."""
    depth_m = ground_depth(tilted(pitch_deg=20), 1.5)
    free, _ = level_query(depth_m, CAMERA)
    told, _ = level_query(depth_m, CAMERA, down_camera=DOWN_AHEAD)
    assert angle_deg(free.R_level_camera, tilted(pitch_deg=20)) < 1
    assert angle_deg(told.R_level_camera, tilted()) < 10


def test_a_sloping_surface_that_covers_little_of_the_image_is_no_ground():
    """A bonnet below the camera falls by 14 degrees in front of a wall. It holds 23 % of the pixels within reach."""
    slope = ground_depth(tilted(pitch_deg=-14), 0.6)
    wall = np.full((120, 160), 6.0, np.float32)
    is_slope = (np.arange(120)[:, None] > 95) & (slope > 0) & (slope < 6)
    level, origin = level_query(np.where(is_slope, slope, wall), CAMERA)
    assert origin == "assumed"
    assert angle_deg(level.R_level_camera, tilted()) < 5
