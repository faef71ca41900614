import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from service.geometry.camera import PinholeCamera
from service.geometry.rigid import R_BODY_OPTICAL, rotation_z, transform_from
from service.registration.kernel import SURFEL, NearestGrid, Piece, packed_map, render

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
    return render((Piece(grid, surfels),), T_map_camera=T, camera=CAMERA, size_m=0.12, reach_m=reach_m)


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


def slowly_drawn(grid, surfels, T, camera, *, size_m, reach_m):
    """Return the same picture without leaving out any region. Squares that end at the centre of a pixel may differ."""
    x = (grid.unpacked(surfels, np.arange(len(surfels)))["xyz"].astype(float) - T[:3, 3]) @ T[:3, :3]
    x = x[(x[:, 2] >= 0.5) & (x[:, 2] <= reach_m)]
    z = x[:, 2]
    u, v = x[:, 0] / z * camera.fx + camera.cx, x[:, 1] / z * camera.fy + camera.cy
    half = np.minimum(size_m / 2 * camera.fx / z, 4)
    depth = np.full((camera.height, camera.width), 1e9)
    for row in range(camera.height):
        of_row = np.abs(v - row) <= half
        covers = np.abs(u[of_row] - np.arange(camera.width)[:, None]) <= half[of_row]
        depth[row] = np.where(covers, z[of_row], 1e9).min(axis=1, initial=1e9)
    return np.where(depth > 1e8, 0, depth)


@given(
    st.integers(0, 10**6),
    st.floats(-180, 180),
    st.floats(-80, 80),
    st.floats(-30, 30),
    st.sampled_from([(20.0, 20.0), (6.0, 20.0), (6.0, 4.0)]),
)
@settings(max_examples=60, deadline=None)
def test_regions_that_are_left_out_have_nothing_to_draw(seed, heading, pitch, roll, focal_px):
    """Walls up to 60 m away, images of 77 to 139 degrees. The reach limits the depth, so the sides of an image see further."""
    rng = np.random.default_rng(seed)
    camera = PinholeCamera(32, 24, focal_px[0], focal_px[1], 15.5, 11.5)
    walls = [wall(x, y=(y, y + 6), z=(z, z + 6), step=0.5) for x, y, z in rng.uniform(-60, 60, (40, 3))]
    R = Rotation.from_euler("zyx", [heading, pitch, roll], degrees=True).as_matrix() @ R_BODY_OPTICAL
    T = transform_from(R, rng.uniform(-20, 20, 3))
    grid, surfels, _ = packed_map(np.concatenate(walls), cell_m=0.4, reach_m=1.2)
    found = render((Piece(grid, surfels),), T_map_camera=T, camera=camera, size_m=1.0, reach_m=40.0)
    expected = slowly_drawn(grid, surfels, T, camera, size_m=1.0, reach_m=40.0)
    assert (np.abs(found - expected) > 0.01).sum() <= 2  # single precision at the border of a square


def test_a_map_without_regions_draws_an_empty_picture():
    grid, surfels, _ = packed_map(wall(5), cell_m=0.4, reach_m=1.2)
    empty = NearestGrid(
        grid.origin_m, grid.cell_m, grid.slots, grid.regions[:0], grid.blocks[:0], grid.cells[:0], grid.others
    )
    found = render((Piece(empty, surfels[:0]),), T_map_camera=AHEAD, camera=CAMERA, size_m=0.1, reach_m=40.0)
    np.testing.assert_array_equal(found, np.zeros((24, 32)))
