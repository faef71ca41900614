import numpy as np
import pytest

from service.confidence.shape import shape_of
from service.imaging.view_grid import ViewGrid

GRID = ViewGrid()
RAYS = GRID.rays_level()
LEAST = np.log(1e-3)


def plane(normal, distance_m):
    """Return the ranges of an infinite plane (level frame: x ahead, y left, z up); 0 where a ray does not intersect it."""
    along = RAYS @ (np.array(normal, float) / np.linalg.norm(normal))
    return np.where(along > 1e-3, distance_m / np.maximum(along, 1e-3), 0.0).astype(np.float32)


def nearest(*ranges):
    stacked = np.stack([np.where(one > 0, one, np.inf) for one in ranges]).min(axis=0)
    return np.where(np.isfinite(stacked), stacked, 0).astype(np.float32)


def shape(ranges_m):
    return shape_of(ranges_m, GRID)


@pytest.mark.parametrize("turn_deg", [0, 25, -40])
def test_a_wall_faces_one_way(turn_deg):
    turn = np.deg2rad(turn_deg)
    assert shape(plane((np.cos(turn), np.sin(turn), 0), 6.0)).facings == pytest.approx(LEAST, abs=0.05)


def test_a_corner_in_the_middle_of_the_view_has_equal_eigenvalues():
    """Two walls at right angles fill half of the cells each. Both eigenvalues are 0.5."""
    corner = nearest(plane((1, 1, 0), 6.0), plane((1, -1, 0), 6.0))
    assert shape(corner).facings == pytest.approx(np.log(0.5), abs=0.02)


def test_a_wall_of_a_quarter_of_the_cells_is_a_quarter():
    """A wall on the left fills the cells beyond 22.5 degrees. Its normal is perpendicular to that of the wall ahead."""
    left = np.deg2rad(22.5)
    both = nearest(plane((1, 0, 0), 6.0), plane((0, 1, 0), 6.0 * np.tan(left)))
    assert np.exp(shape(both).facings) == pytest.approx(0.25, abs=0.03)


def test_ground_and_ceiling_face_no_way():
    level = nearest(plane((0, 0, -1), 1.5), plane((0, 0, 1), 2.0))
    assert shape(level).facings == pytest.approx(LEAST)


def test_depth_edges_are_no_surface():
    """Alternating columns show two walls far behind each other. All cells are edges, and no pair of cells has a normal."""
    far, near = plane((1, 0, 0), 20.0), plane((1, 0, 0), 5.0)
    striped = np.where(np.arange(GRID.columns) % 2 == 0, near, far).astype(np.float32)
    found = shape(striped)
    assert found.edges == 1.0
    assert found.facings == pytest.approx(LEAST, abs=0.1)


def test_a_smooth_wall_has_no_edges_and_one_post_two_a_row():
    wall = plane((1, 0, 0), 10.0)
    assert shape(wall).edges == 0.0
    wall[:, 60:64] = 4.0
    assert shape(wall).edges == pytest.approx(2 / (GRID.columns - 1))


def test_far_is_the_median_above_the_horizon_whatever_lies_below():
    ball = np.full((GRID.rows, GRID.columns), 12.0, np.float32)
    ball[GRID.elevations_rad < 0] = 2.0
    assert shape(ball).far == pytest.approx(np.log(12.0))


@pytest.mark.parametrize("count", [0, 20])
def test_where_hardly_anything_is_seen_far_is_the_grids_limit(count):
    empty = np.zeros((GRID.rows, GRID.columns), np.float32)
    empty[0, :count] = 3.0
    found = shape(empty)
    assert found.far == pytest.approx(np.log(GRID.max_range_m))
    assert np.isfinite([found.facings, found.edges]).all()


def test_gaps_are_neither_edges_nor_surfaces():
    wall = plane((1, 0, 0), 10.0)
    holed = wall.copy()
    holed[np.random.default_rng(1).random(wall.shape) < 0.3] = 0
    assert shape(holed).edges == 0.0
    assert shape(holed).facings == pytest.approx(shape(wall).facings, abs=0.05)
