import cv2
import numpy as np
import pytest

from service.errors import NoDepthError
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import rotation_z
from service.imaging.query_view import query_view, query_views
from service.imaging.view_grid import PLANES, ViewGrid

GRID = ViewGrid(rows=16, columns=32)
SEEN = np.ones(16, np.bool_)
CAMERA = PinholeCamera(320, 240, 160.0, 160.0, 159.5, 119.5)
WALL_M, HEIGHT_M = 10.0, 1.5


def wall_depth(camera=CAMERA, *, wall_m=WALL_M):
    """Return the depth of flat ground and a vertical wall perpendicular to the optical axis."""
    down = (np.arange(camera.height) - camera.cy) / camera.fy
    z = np.minimum(wall_m, HEIGHT_M / np.maximum(down, 1e-6))
    return np.repeat(z[:, None], camera.width, axis=1).astype(np.float32)


def grey(camera=CAMERA, level=120):
    return np.full((camera.height, camera.width, 3), level, np.uint8)


def view_of(rgb=None, depth_m=None, camera=CAMERA, *, grid=GRID, rows_seen=SEEN, **options):
    rgb = grey(camera) if rgb is None else rgb
    depth_m = wall_depth(camera) if depth_m is None else depth_m
    return query_view(rgb, depth_m, camera, grid=grid, rows_seen=rows_seen, **options)


def plane(view, name):
    return view.planes[PLANES.index(name)]


def test_a_wall_appears_at_its_range_along_every_ray():
    view = view_of()
    rays = GRID.rays_level()
    above = np.arange(16) < 8
    expected = WALL_M / rays[..., 0]
    inside = above[:, None] & (plane(view, "range_m") > 0)
    assert inside[above].mean() > 0.95
    np.testing.assert_allclose(plane(view, "range_m")[inside], expected[inside], rtol=0.02)


def test_the_ground_appears_below_at_height_zero():
    heights = plane(view_of(), "height_m")
    np.testing.assert_allclose(heights[13:, 4:28], 0.0, atol=0.15)


def test_the_camera_height_is_that_over_the_ground():
    assert view_of().height_m == pytest.approx(HEIGHT_M, abs=0.08)


@pytest.mark.parametrize("size", [(160, 120), (640, 480)])
def test_depth_of_another_size_of_the_same_aspect_gives_the_same_ranges(size):
    other = view_of(depth_m=wall_depth(CAMERA.scaled_to(*size)))
    both = (plane(view_of(), "range_m") > 0) & (plane(other, "range_m") > 0)
    assert both.mean() > 0.9
    np.testing.assert_allclose(plane(other, "range_m")[both], plane(view_of(), "range_m")[both], rtol=0.06)


@pytest.mark.parametrize("size", [(160, 120), (640, 480)])
def test_rgb_of_another_size_of_the_same_aspect_gives_the_same_colours(size):
    smooth = np.zeros((240, 320, 3), np.uint8)
    smooth[..., 0], smooth[..., 2] = np.linspace(0, 200, 320), np.linspace(50, 150, 240)[:, None]
    one, other = view_of(smooth), view_of(cv2.resize(smooth, size, interpolation=cv2.INTER_LINEAR))
    for name in ("v1", "v2"):
        np.testing.assert_allclose(plane(other, name), plane(one, name), atol=3.0)


def test_grey_pictures_have_no_colour_planes():
    view = view_of()
    np.testing.assert_allclose(view.planes[1:3], 0.0, atol=1e-3)


def test_a_blue_left_half_is_left_in_the_view():
    rgb = grey()
    rgb[:, :160] = (20, 20, 220)
    v1 = plane(view_of(rgb), "v1")
    assert v1[8, 2:15].min() > 100
    assert abs(v1[8, 17:30]).max() < 1


@pytest.mark.parametrize("turn_deg", [-20.0, 15.0])
def test_a_turned_view_sees_the_wall_slanted(turn_deg):
    view = view_of(turn_rad=float(np.deg2rad(turn_deg)))
    rays = GRID.rays_level() @ rotation_z(np.deg2rad(turn_deg)).T
    ranges = plane(view, "range_m")[:8]
    seen = ranges > 0
    assert seen.mean() > 0.6
    np.testing.assert_allclose(ranges[seen], (WALL_M / rays[:8, :, 0])[seen], rtol=0.02)


def test_a_turned_view_is_not_observed_beyond_the_picture():
    observed = plane(view_of(turn_rad=float(np.deg2rad(20))), "observed")
    assert not observed[:, :6].any()
    assert observed[8, 10:].all()


def test_a_narrow_camera_observes_the_middle_only():
    narrow = PinholeCamera(320, 240, 440.0, 440.0, 159.5, 119.5)  # 40 degrees
    observed = plane(view_of(camera=narrow), "observed")
    outside = np.abs(np.rad2deg(GRID.azimuths_rad)) > 23
    assert not observed[:, outside].any()
    assert observed[8, np.abs(np.rad2deg(GRID.azimuths_rad)) < 18].all()


def test_outside_of_a_narrow_camera_all_planes_are_zero():
    narrow = PinholeCamera(320, 240, 440.0, 440.0, 159.5, 119.5)
    view = view_of(grey(narrow, 30), camera=narrow)
    assert not view.planes[:, plane(view, "observed") == 0].any()


def test_rows_that_the_survey_does_not_see_are_blank():
    view = view_of(rows_seen=np.arange(16) >= 5)
    assert not view.planes[:, :5].any()
    assert plane(view, "observed")[5:, 8:24].all()


def test_far_and_missing_depth_is_observed_but_not_measured():
    depth_m = wall_depth()
    depth_m[:120] = 60.0
    view = view_of(depth_m=depth_m)
    assert not plane(view, "range_m")[:7].any()
    assert plane(view, "observed")[:7, 8:24].all()


def test_single_wrong_pixels_do_not_move_a_cell():
    depth_m = wall_depth()
    rng = np.random.default_rng(0)
    depth_m[rng.random(depth_m.shape) < 0.05] = 3.0
    clean, dirty = plane(view_of(), "range_m"), plane(view_of(depth_m=depth_m), "range_m")
    assert np.mean(np.abs(dirty - clean)[:7] < 0.3) > 0.95


@pytest.mark.parametrize("depth_m", [0.0, 0.2, 70.0])
def test_a_picture_without_a_usable_depth_is_refused_with_the_limits(depth_m):
    with pytest.raises(NoDepthError, match=r"0\.5-40 m"):
        view_of(depth_m=np.full((240, 320), depth_m, np.float32))


@pytest.mark.parametrize(
    ("depth_m", "why"),
    [
        (5000.0, "the median depth is 5000 m, which looks like millimetres; send depth.scale_m = 0.001"),
        (
            0.005,
            "the median depth is 0.005 m, which looks like metres that were read as millimetres; send depth.scale_m = 1",
        ),
        (70.0, "check depth.scale_m, depth.kind and the camera intrinsics"),
        (0.0, "no pixel has a depth: check the depth image, and depth.max_range_m if you sent it"),
    ],
)
def test_a_refused_depth_says_which_unit_it_looks_like(depth_m, why):
    with pytest.raises(NoDepthError) as caught:
        view_of(depth_m=np.full((240, 320), depth_m, np.float32))
    assert f"degrees of elevation): {why}" in caught.value.message


def test_the_measured_share_is_that_of_the_cells():
    view = view_of()
    assert view.measured_share == pytest.approx(np.mean(plane(view, "range_m") > 0))


def test_views_at_several_turns_are_those_at_each_of_them():
    turns = (-3, 0, 5)
    rng = np.random.default_rng(0)
    rgb, depth_m = rng.integers(0, 255, (240, 320, 3), np.uint8), wall_depth()
    depth_m *= rng.uniform(0.9, 1.1, depth_m.shape).astype(np.float32)
    together = query_views(rgb, depth_m, CAMERA, grid=GRID, rows_seen=SEEN, turns=turns)
    assert together.turns_rad == tuple(turn * GRID.column_rad for turn in turns)
    for planes, turn_rad in zip(together.planes, together.turns_rad, strict=True):
        alone = query_view(rgb, depth_m, CAMERA, grid=GRID, rows_seen=SEEN, turn_rad=turn_rad).planes
        # A ray that falls just between two pixels may go either way.
        assert np.mean(~np.isclose(planes[:5], alone[:5], rtol=1e-4, atol=1e-3)) < 0.002
        np.testing.assert_allclose(planes[5], alone[5], atol=0.2)


def test_a_pixel_that_the_lens_did_not_see_is_neither_measured_nor_observed():
    """The lens saw the left two thirds of the image. Beyond them, the images hold what must not count."""
    observed = np.repeat(np.arange(CAMERA.width)[None] < 213, CAMERA.height, axis=0)
    rgb, depth_m = grey(), wall_depth()
    rgb[~observed] = 255
    partial, whole = view_of(rgb, depth_m, observed=observed), view_of()
    right = plane(partial, "observed").any(axis=0).argmin()  # first column without an observed cell
    assert 18 < right < 26
    for name in ("range_m", "height_m", "v1", "observed", "brightness"):
        assert not plane(partial, name)[:, right:].any()
    for name in ("range_m", "height_m", "observed"):
        np.testing.assert_allclose(plane(partial, name)[:, : right - 1], plane(whole, name)[:, : right - 1], atol=0.05)
    assert partial.measured_share < whole.measured_share
