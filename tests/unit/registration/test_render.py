import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from service.geometry.camera import PinholeCamera
from service.geometry.rigid import R_BODY_OPTICAL, rotation_z, transform_from
from service.registration.kernel import SURFEL, NearestGrid, packed_map, render

CAMERA = PinholeCamera(32, 24, 20.0, 20.0, 15.5, 11.5)
AHEAD = transform_from(R_BODY_OPTICAL, np.zeros(3))


def wall(x, *, y=(-20, 20), z=(-20, 20), step=0.1):
    """Return surfels every ``step`` metres on a wall ``x`` metres ahead."""
    ys, zs = (np.arange(low + step / 2, high, step) for low, high in (y, z))
    grid = np.stack(np.meshgrid([float(x)], ys, zs, indexing="ij"), axis=-1).reshape(-1, 3)
    surfels = np.zeros(len(grid), SURFEL)
    surfels["xyz"], surfels["normal"] = grid, [1, 0, 0]
    return surfels


def drawn(*walls, T=AHEAD, reach_m=40.0):
    grid, surfels, _ = packed_map(np.concatenate(walls), cell_m=0.4, reach_m=1.2)
    return render(grid, surfels, T_map_camera=T, camera=CAMERA, size_m=0.12, reach_m=reach_m)


def test_a_wall_that_fills_the_view_stands_at_its_distance_in_every_pixel():
    np.testing.assert_allclose(drawn(wall(10)), np.full((24, 32), 10.0), rtol=3e-5)


def test_a_part_of_a_wall_is_drawn_in_its_pixels_alone():
    """At 10 m, a metre is 2 px: y in 0..4 m is u in 7.5..15.5, z in 1..3 m is v in 5.5..9.5. Surfels extend 0.02 m."""
    found = drawn(wall(10, y=(0, 4), z=(1, 3), step=0.2))
    expected = np.zeros((24, 32))
    expected[6:10, 8:16] = 10
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_a_turned_and_moved_camera_sees_the_wall_from_where_it_stands():
    """From (4, 3) with the view along y, a wall at x = 10 is 6 m to the right: u - cx = 20 * 6 / depth."""
    T = transform_from(rotation_z(np.pi / 2) @ R_BODY_OPTICAL, np.array([4.0, 3.0, 0.0]))
    found = drawn(wall(10, y=(2, 18), z=(-3, 3), step=0.05), T=T)
    row = found[11]
    assert (row[:23] == 0).all()
    np.testing.assert_allclose(row[25:], 6 * 20 / (np.arange(25, 32) - 15.5), rtol=0.05)


def test_near_surfaces_hide_far_ones_in_any_order():
    far, pole = wall(10), wall(5, y=(-0.4, 0.4))
    for found in (drawn(far, pole), drawn(pole, far)):
        np.testing.assert_allclose(found[:, 14:18], 5, rtol=1e-6)
        np.testing.assert_allclose(found[:, [*range(13), *range(19, 32)]], 10, rtol=1e-6)


def test_nothing_behind_the_camera_is_drawn():
    assert not drawn(wall(-10), wall(-1)).any()


@pytest.mark.parametrize(("x", "is_drawn"), [(0.4, False), (0.6, True), (19.9, True), (20.1, False)])
def test_nothing_is_drawn_before_half_a_metre_or_beyond_reach(x, is_drawn):
    found = drawn(wall(x), reach_m=20.0)
    assert found.any() == is_drawn


def test_surfels_grow_in_the_picture_as_they_come_near():
    """0.12 m are 2.4 px at 1 m and 0.6 px at 4 m. Between four pixels that covers four of them, and none."""
    one = wall(1, y=(-0.05, 0.05), z=(-0.05, 0.05))
    assert len(one) == 1
    assert (drawn(one) > 0).sum() == 4
    assert (drawn(wall(4, y=(-0.05, 0.05), z=(-0.05, 0.05))) > 0).sum() == 0


@given(st.integers(0, 10**6), st.floats(-180, 180), st.floats(-80, 80), st.floats(-30, 30))
@settings(max_examples=40, deadline=None)
def test_a_region_outside_the_field_of_view_has_nothing_to_draw(seed, heading, pitch, roll):
    """A map in one frame is drawn as one whose regions lie elsewhere: a far surfel moves the corner of the grid."""
    rng = np.random.default_rng(seed)
    walls = [wall(x, y=(y, y + 4), z=(z, z + 4)) for x, y, z in rng.uniform(-45, 45, (20, 3))]
    R = Rotation.from_euler("zyx", [heading, pitch, roll], degrees=True).as_matrix() @ R_BODY_OPTICAL
    T = transform_from(R, rng.uniform(-5, 5, 3))
    far = wall(-400, y=(-400, -399.9), z=(-400, -399.9))
    far["xyz"] += rng.uniform(-40, 0, 3)
    one, other = drawn(*walls, T=T), drawn(*walls, far, T=T)
    assert (np.abs(one - other) > 1e-3).mean() < 0.02  # a surfel at the border of a pixel may round to the next one


def test_a_map_without_regions_draws_an_empty_picture():
    grid, surfels, _ = packed_map(wall(5), cell_m=0.4, reach_m=1.2)
    empty = NearestGrid(
        grid.origin_m, grid.cell_m, grid.slots, grid.regions[:0], grid.blocks[:0], grid.nearest[:0], grid.others
    )
    found = render(empty, surfels[:0], T_map_camera=AHEAD, camera=CAMERA, size_m=0.1, reach_m=40.0)
    np.testing.assert_array_equal(found, np.zeros((24, 32)))
