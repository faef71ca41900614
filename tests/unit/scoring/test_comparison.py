from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.geometry.camera import PinholeCamera
from service.registration.points import PointSettings
from service.registration.rays import RaySettings
from service.registration.surfel_map import SurfelMap
from service.registration.visibility import SurfelRaycaster
from service.scoring.comparison import (
    AZIMUTH_RAD,
    COLUMNS,
    ELEVATION_RAD,
    PLANES,
    ROWS,
    FrameCells,
    comparison_of,
)
from service.scoring.measured import measure
from service.scoring.photometry import PhotometrySettings
from service.scoring.ray_image import RayImage, ray_image_of

PHOTOMETRY = PhotometrySettings()
CAMERA = PinholeCamera(120, 90, 60.0, 60.0, 59.5, 44.5)
LEVEL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


@pytest.fixture
def measured_with(frame_with, matches_at):
    """Return a function that measures a frame with given rotation, images and camera."""
    frame = frame_with(matches_at([(0, 0, 2)], [0], [0.9]))

    def measured(*, R=LEVEL, depth_m=None, rgb=None, camera=CAMERA, observed=None):
        depth_m = np.full((camera.height, camera.width), 8.0, np.float32) if depth_m is None else depth_m
        rgb = np.full((*depth_m.shape, 3), 90, np.uint8) if rgb is None else rgb
        query = replace(frame.query, depth_m=depth_m, rgb=rgb, camera=camera, observed=observed)
        (found,) = measure(
            (replace(frame, query=query, views=replace(frame.views, R_level_camera=R)),),
            PointSettings(),
            focal_baseline_px_m=80.0,
            is_rig=False,
        )
        return found

    return measured


def image_of(one, z_m, mapped_m, sigma=0.01, climb=0.0, surfel_of=-1):
    """Return an image of equal rays, or of rays with these surfels."""
    shape = (one.picture.camera.height, one.picture.camera.width)
    return RayImage(
        surfel_of=np.broadcast_to(np.asarray(surfel_of, np.int32), shape).copy(),
        z_m=np.full(shape, float(z_m)),
        mapped_m=np.full(shape, float(mapped_m)),
        sigma=np.full(shape, sigma),
        climb=np.full(shape, climb),
        camera_m=1.5,
    )


def planes(one, street, image):
    found = comparison_of(FrameCells.of(one, PHOTOMETRY), image, street, PHOTOMETRY)
    assert found.shape == (len(PLANES), ROWS, COLUMNS)
    assert found.dtype == np.float32
    assert np.abs(found).max() <= 1
    return dict(zip(PLANES, found, strict=True))


def with_brightness(street_map, intensities):
    """Return the same surfels with these intensities."""
    return SurfelMap.prepare(street_map.origin_m, street_map.unpacked(np.s_[:]), np.asarray(intensities, np.float32))


@pytest.fixture
def surfels(street_map):
    return SurfelRaycaster(street_map, RaySettings()).cloud


def test_the_middle_of_the_grid_is_the_heading_at_the_horizon(measured_with):
    """Cells left and right of the middle show pixels on both sides of the optical axis, whatever the heading in the level frame is."""
    for turn in (0.0, 1.0, -2.5):
        cos, sin = np.cos(turn), np.sin(turn)
        one = measured_with(R=np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]) @ LEVEL)
        cells, width = FrameCells.of(one, PHOTOMETRY), one.picture.camera.width
        rows, columns = np.divmod(
            cells.pixel[ROWS // 2 - 1 : ROWS // 2 + 1, COLUMNS // 2 - 1 : COLUMNS // 2 + 1], width
        )
        centre = one.picture.camera.cx, one.picture.camera.cy
        assert np.abs(columns - centre[0]).max() <= 1.5
        assert np.abs(rows - centre[1]).max() <= 1.5
        assert (np.diff(columns, axis=1) >= 0).all()
        assert (np.diff(rows, axis=0) >= 0).all()


def test_the_grid_has_equal_angles(measured_with):
    one = measured_with()
    cells, camera = FrameCells.of(one, PHOTOMETRY), one.picture.camera
    row, column = 20, 100
    azimuth = AZIMUTH_RAD * (1 - (2 * column + 1) / COLUMNS)
    elevation = ELEVATION_RAD * (1 - (2 * row + 1) / ROWS)
    v, u = divmod(int(cells.pixel[row, column]), camera.width)
    assert u == round(camera.cx - camera.fx * np.tan(azimuth))
    assert v == round(camera.cy - camera.fy * np.tan(elevation) / np.cos(azimuth))


def test_a_camera_that_looks_down_has_the_same_directions(measured_with):
    """The horizon moves up in the image, not in the grid.

    The upper edge of the image is at tan(45 / 60) = 36.87 degrees above the axis, so at 16.87 degrees above the horizon. Row 9 of the grid
    is at 16.875 degrees.
    """
    pitch = np.deg2rad(20.0)
    down = np.array([[np.cos(pitch), 0, np.sin(pitch)], [0, 1, 0], [-np.sin(pitch), 0, np.cos(pitch)]])
    one = measured_with(R=down @ LEVEL)
    cells, camera = FrameCells.of(one, PHOTOMETRY), one.picture.camera
    v = cells.pixel[ROWS // 2, COLUMNS // 2] // camera.width
    assert v == pytest.approx(camera.cy - camera.fy * np.tan(pitch), abs=1.5)
    middle = cells.in_view[:, COLUMNS // 2]
    assert not middle[:9].any()
    assert middle[10:].all()


def test_directions_outside_of_the_image_are_empty(measured_with, surfels):
    narrow = PinholeCamera(120, 90, 240.0, 240.0, 59.5, 44.5)
    one = measured_with(camera=narrow)
    found = planes(one, surfels, image_of(one, 8, 8))
    inside = found["in_view"] > 0
    assert 0 < inside.mean() < 0.3
    for plane in found.values():
        assert (plane[~inside] == 0).all()


def test_equal_depth_has_no_difference(measured_with, surfels):
    one = measured_with()
    found = planes(one, surfels, image_of(one, 8, 8))
    inside = found["in_view"] > 0
    assert (found["measured"][inside] == 1).all()
    assert (found["mapped"][inside] == 1).all()
    np.testing.assert_allclose(found["inverse_depth"][inside], (1 / 8) / 0.25)
    np.testing.assert_allclose(found["mapped_inverse_depth"][inside], (1 / 8) / 0.25)
    np.testing.assert_allclose(found["height"][inside], 0.15, rtol=1e-6)
    np.testing.assert_allclose(found["relative_noise"][inside], 0.08, rtol=1e-6)
    assert (found["difference_sigmas"] == 0).all()
    assert (found["difference_ratio"] == 0).all()


def test_differences_have_the_sign_of_the_nearer_side(measured_with, surfels):
    """At 4 m instead of 8 m: (1/4 - 1/8) / 0.05 = 2.5 standard deviations, and a ratio of 2."""
    one = measured_with()
    found = planes(one, surfels, image_of(one, 4, 8, sigma=0.05))
    inside = found["in_view"] > 0
    np.testing.assert_allclose(found["difference_sigmas"][inside], np.tanh(2.5 / 4), rtol=1e-6)
    np.testing.assert_allclose(found["difference_ratio"][inside], np.tanh(3.0), rtol=1e-6)
    behind = planes(one, surfels, image_of(one, 16, 8, sigma=0.05))
    np.testing.assert_allclose(behind["difference_sigmas"][inside], -np.tanh(1.25 / 4), rtol=1e-6)


def test_a_ray_that_climbs_ends_higher(measured_with, surfels):
    """1.5 m, and 0.25 m for each metre of depth: 3.5 m at 8 m and 2.5 m at 4 m. Downwards: 0.5 m at 4 m, and the least height at 20 m."""
    one = measured_with()
    up, down = (planes(one, surfels, image_of(one, z, 4, climb=climb)) for z, climb in ((8, 0.25), (20, -0.25)))
    inside = up["in_view"] > 0
    np.testing.assert_allclose(up["height"][inside], 0.35, rtol=1e-6)
    np.testing.assert_allclose(up["mapped_height"][inside], 0.25, rtol=1e-6)
    np.testing.assert_allclose(down["height"][inside], -0.2, rtol=1e-6)
    np.testing.assert_allclose(down["mapped_height"][inside], 0.05, rtol=1e-6)


@pytest.mark.parametrize(("z_m", "mapped_m"), [(0, 8), (8, 0), (0, 0)])
def test_what_is_unknown_is_zero(measured_with, surfels, z_m, mapped_m):
    one = measured_with()
    found = planes(one, surfels, image_of(one, z_m, mapped_m))
    inside = found["in_view"] > 0
    assert (found["measured"][inside] == (z_m > 0)).all()
    assert (found["mapped"][inside] == (mapped_m > 0)).all()
    assert (found["difference_sigmas"] == 0).all()
    assert (found["difference_ratio"] == 0).all()
    if z_m == 0:
        assert (found["height"] == 0).all()
    if mapped_m == 0:
        assert (found["mapped_height"] == 0).all()
        assert (found["relative_noise"] == 0).all()


def test_brightness_is_relative_to_the_image(measured_with, surfels):
    """A bright right half. Twice the light changes nothing but the offset of the logarithm."""
    rgb = np.full((90, 120, 3), 40, np.uint8)
    rgb[:, 60:] = 160
    one, brighter = measured_with(rgb=rgb), measured_with(rgb=rgb // 2)
    found, same = (planes(each, surfels, image_of(each, 8, 8))["brightness"] for each in (one, brighter))
    middle = found[ROWS // 2]
    assert middle[COLUMNS // 2 - 10] < -0.1 < 0.1 < middle[COLUMNS // 2 + 10]
    np.testing.assert_allclose(found, same, atol=0.06)


def test_pixels_that_the_lens_did_not_see_are_no_dark_surfaces(measured_with, surfels):
    """The left third of the image is black and unobserved, the middle third has a grey level of 40, and the right third one of 160.

    The logarithms of the seen pixels are log 48 and log 168. Their mean is half of the sum.
    """
    rgb, observed = np.zeros((90, 120, 3), np.uint8), np.ones((90, 120), np.bool_)
    rgb[:, 40:80], rgb[:, 80:], observed[:, :40] = 40, 160, False
    one = measured_with(rgb=rgb, observed=observed)
    found, column = planes(one, surfels, image_of(one, 8, 8)), FrameCells.of(one, PHOTOMETRY).pixel % 120
    inside = found["in_view"] > 0
    assert {True, False} == set((column[inside] < 40).tolist())
    half = 0.5 * np.log(168 / 48) / 3
    np.testing.assert_array_equal(found["brightness"][inside & (column < 40)], 0)
    np.testing.assert_allclose(found["brightness"][inside & (column >= 40) & (column < 80)], -half, rtol=1e-5)
    np.testing.assert_allclose(found["brightness"][inside & (column >= 80)], half, rtol=1e-5)
    blind = measured_with(rgb=rgb, observed=np.zeros_like(observed))
    assert (planes(blind, surfels, image_of(blind, 8, 8))["brightness"] == 0).all()


def test_an_image_that_the_lens_saw_whole_is_compared_as_one_of_a_pinhole_camera(measured_with):
    rgb = np.random.default_rng(0).integers(0, 256, (90, 120, 3), np.uint8)
    plain, rectified = measured_with(rgb=rgb), measured_with(rgb=rgb, observed=np.ones((90, 120), np.bool_))
    one, same = (FrameCells.of(each, PHOTOMETRY).brightness for each in (plain, rectified))
    np.testing.assert_allclose(one, same, atol=1e-6)
    assert one.std() > 0.3


@settings(max_examples=20)
@given(seed=st.integers(0, 2**32 - 1))
def test_each_cell_shows_what_the_whole_image_has_at_its_pixel(street_map, seed):
    """An image of 64 x 128 pixels whose cells are its own pixels shows all of them. Any other cells show some of these, to the bit."""
    rng, shape, count = np.random.default_rng(seed), (ROWS, COLUMNS), len(street_map.surfels)
    intensities = np.where(rng.random(count) < 0.1, np.nan, rng.gamma(2.0, 20.0, count)).astype(np.float32)
    surfels = with_brightness(street_map, intensities)
    z_m, mapped_m = (np.where(rng.random(shape) < 0.3, 0.0, rng.uniform(0.5, 60.0, shape)) for _ in range(2))
    image = RayImage(
        surfel_of=np.where(rng.random(shape) < 0.3, -1, rng.integers(0, count, shape)).astype(np.int32),
        z_m=z_m,
        mapped_m=mapped_m,
        sigma=rng.uniform(1e-4, 0.1, shape),
        climb=rng.normal(0.0, 0.5, shape),
        camera_m=1.5,
    )
    brightness = rng.normal(0.0, 2.0, shape).astype(np.float32)
    own = FrameCells(np.arange(ROWS * COLUMNS).reshape(shape), np.ones(shape, np.bool_), brightness)
    whole = comparison_of(own, image, surfels, PHOTOMETRY).reshape(len(PLANES), -1)
    in_view = rng.random(shape) < 0.8
    pixel = np.where(in_view, rng.integers(0, ROWS * COLUMNS, shape), 0)
    shown = np.where(in_view, brightness.ravel()[pixel], np.float32(0))
    found = comparison_of(FrameCells(pixel, in_view, shown), image, surfels, PHOTOMETRY)
    np.testing.assert_array_equal(found, whole[:, pixel] * in_view)
    assert (found[PLANES.index("mapped_brightness")] != 0).mean() > 0.3


@pytest.fixture
def bright(street_map):
    """Return surfels of intensity 10 and 30, and some without, and a surfel of each of these three kinds."""
    cloud = with_brightness(street_map, np.resize([10.0, 30.0, np.nan], len(street_map.surfels)))
    values = cloud.brightness_of(np.arange(len(cloud.surfels)))
    return cloud, *(int(np.flatnonzero(each)[0]) for each in (values == 10, values == 30, np.isnan(values)))


def test_each_cell_shows_the_brightness_of_the_surfel_at_its_pixel(measured_with, bright):
    """The left third of the image meets a surfel of 10, the middle one of 30, and the rest none or one without an intensity.

    The known mean is 20. The logarithms of 0.5 and 1.5, with a dark share of 0.03, fill the scale at 3.
    """
    cloud, dark, light, unknown = bright
    one, surfel_of = measured_with(), np.full((90, 120), -1)
    surfel_of[:, :40], surfel_of[:, 40:80], surfel_of[::2, 80:] = dark, light, unknown
    found = planes(one, cloud, image_of(one, 8, 8, surfel_of=surfel_of))
    inside, column = found["in_view"] > 0, FrameCells.of(one, PHOTOMETRY).pixel % 120
    for which, expected in ((column < 40, np.log(0.53) / 3), ((column >= 40) & (column < 80), np.log(1.53) / 3)):
        np.testing.assert_allclose(found["mapped_brightness"][inside & which], expected, rtol=1e-5)
        assert (inside & which).any()
    assert (found["mapped_brightness"][inside & (column >= 80)] == 0).all()


def test_without_surfels_the_brightness_of_the_map_is_not_shown(measured_with, bright):
    cloud, dark, light, _ = bright
    one, surfel_of = measured_with(), np.full((90, 120), dark)
    surfel_of[:45] = light
    shown, hidden = (planes(one, each, image_of(one, 8, 8, surfel_of=surfel_of)) for each in (cloud, None))
    for name in PLANES:
        if name != "mapped_brightness":
            np.testing.assert_array_equal(shown[name], hidden[name])
    inside = shown["in_view"] > 0
    assert (np.abs(shown["mapped_brightness"][inside]) > 0.1).all()
    assert (hidden["mapped_brightness"] == 0).all()


def test_a_map_without_brightness_has_none(measured_with, street_map):
    raycaster = SurfelRaycaster(street_map, RaySettings())
    one = measured_with()
    found = planes(one, raycaster.cloud, image_of(one, 8, 8, surfel_of=0))
    assert (found["mapped_brightness"] == 0).all()


def test_the_right_pose_agrees_with_the_map(street_map, frame_with, matches_at, candidate):
    raycaster = SurfelRaycaster(street_map, RaySettings())
    frame = frame_with(matches_at([(0, 0, 2)], [0], [0.9]))
    pose = candidate(xyz=(0.0, 0.0, 1.5)).registered
    T = frame.pose_of_camera(pose.T_map_level)
    query = replace(frame.query, depth_m=raycaster.depth(T, CAMERA).astype(np.float32), camera=CAMERA)
    (one,) = measure((replace(frame, query=query),), PointSettings(), focal_baseline_px_m=80.0, is_rig=True)
    right, wrong = (
        planes(one, raycaster.cloud, ray_image_of(raycaster, one, candidate(xyz=xyz).registered))
        for xyz in ((0.0, 0.0, 1.5), (0.0, 1.5, 1.5))
    )
    both = (right["measured"] > 0) & (right["mapped"] > 0)
    assert both.mean() > 0.3
    assert (np.abs(right["difference_ratio"][both]) > 0.1).mean() < 0.05
    assert (np.abs(wrong["difference_ratio"][both]) > 0.1).mean() > 0.2
    # The lowest rows show the ground, and the upper ones walls higher than the camera.
    assert np.abs(right["height"][-8:][both[-8:]]).max() < 0.02
    assert np.abs(right["mapped_height"][-8:][both[-8:]]).max() < 0.02
    assert right["height"][: ROWS // 2 - 4][both[: ROWS // 2 - 4]].min() > 0.15
    assert right["mapped_height"][: ROWS // 2 - 4][both[: ROWS // 2 - 4]].min() > 0.15
    assert both[-8:].any()
    assert both[: ROWS // 2 - 4].any()
