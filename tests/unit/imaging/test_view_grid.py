import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.imaging.view_grid import (
    PLANES,
    ViewGrid,
    brightness,
    fan_planes,
    heights_of,
    panorama_from_points,
    survey_planes,
    view_from_panorama,
)

GRID = ViewGrid(rows=9, columns=16)


def points_at(elevation_deg, azimuth_deg, range_m, intensity=0.5):
    elevation, azimuth = np.deg2rad(np.atleast_1d(elevation_deg)), np.deg2rad(np.atleast_1d(azimuth_deg))
    flat = np.cos(elevation)
    rays = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=-1)
    xyz = rays * np.atleast_1d(range_m)[:, None]
    return np.c_[xyz, np.broadcast_to(intensity, len(xyz))].astype(np.float32)


def both_of(points, heading_deg=0.0):
    return view_from_panorama(panorama_from_points(points, GRID), float(np.deg2rad(heading_deg)), GRID)


def view_of(points, heading_deg=0.0):
    return both_of(points, heading_deg)[0]


def test_rows_run_from_the_top_to_the_bottom():
    np.testing.assert_allclose(np.rad2deg(GRID.elevations_rad[[0, 4, 8]]), [15, 0, -15], atol=1e-9)


def test_azimuth_grows_to_the_left():
    np.testing.assert_allclose(np.rad2deg(GRID.azimuths_rad[[0, 15]]), [45 - 90 / 32, -45 + 90 / 32])


def test_rays_of_cells_are_unit_and_look_where_the_cell_lies():
    rays = GRID.rays_level()
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1.0)
    elevation, azimuth = np.arcsin(rays[..., 2]), np.arctan2(rays[..., 1], rays[..., 0])
    np.testing.assert_allclose(elevation, np.broadcast_to(GRID.elevations_rad[:, None], elevation.shape))
    np.testing.assert_allclose(azimuth, np.broadcast_to(GRID.azimuths_rad, azimuth.shape))


@pytest.mark.parametrize(("row", "column"), [(0, 0), (0, 15), (4, 7), (8, 3)])
def test_a_point_lands_in_the_cell_of_its_ray_with_its_range(row, column):
    azimuth_deg = np.rad2deg(GRID.azimuths_rad[column])
    view = view_of(points_at(np.rad2deg(GRID.elevations_rad[row]), azimuth_deg, 12.5))
    assert view[row, column] == pytest.approx(12.5, abs=1e-4)
    # The panorama is twice as dense as a view: a neighbour may see the point, no other cell does.
    view[row, max(0, column - 1) : column + 2] = 0
    assert not view.any()


def test_of_two_points_in_a_cell_the_one_nearer_to_its_ray_counts():
    elevation, azimuth = np.rad2deg(GRID.elevations_rad[4]), np.rad2deg(GRID.azimuths_rad[5])
    view = view_of(points_at([elevation + 1.5, elevation + 0.2, elevation - 1.2], [azimuth] * 3, [7.0, 9.0, 8.0]))
    assert view[4, 5] == pytest.approx(9.0, abs=1e-4)


@pytest.mark.parametrize("columns", [1, 10, 32, 64, -43, 130])
def test_a_view_shifts_with_its_heading(columns):
    step_deg = 360.0 / GRID.around
    azimuths = np.arange(GRID.around) * step_deg
    ranges = np.random.default_rng(1).uniform(3, 30, GRID.around)
    turned = view_of(points_at(np.zeros(GRID.around), azimuths + columns * step_deg, ranges), columns * step_deg)
    np.testing.assert_allclose(turned, view_of(points_at(np.zeros(GRID.around), azimuths, ranges)), atol=1e-4)


def test_a_thing_moves_to_the_right_as_the_heading_turns_left():
    thing = points_at(np.zeros(9), np.linspace(-6, 6, 9), np.full(9, 10.0))
    columns = [np.flatnonzero(view_of(thing, heading)[4]).mean() for heading in (-30.0, -15.0, 0.0, 15.0, 30.0)]
    assert (np.diff(columns) > 1).all()


def test_the_panorama_closes_over_its_seam():
    view = view_of(points_at(np.zeros(9), np.linspace(174, 186, 9), np.full(9, 10.0)), 180.0)
    np.testing.assert_allclose(view[4, 7:9], 10.0, atol=1e-4)


@pytest.mark.parametrize("range_m", [0.3, 40.5, 90.0])
def test_values_outside_the_limits_are_no_measurement(range_m):
    assert not view_of(points_at(0.0, 0.0, range_m)).any()


@pytest.mark.parametrize("elevation_deg", [18.0, -18.0])
def test_points_above_or_below_the_rows_are_left_out(elevation_deg):
    assert not view_of(points_at(elevation_deg, 0.0, 10.0)).any()


@pytest.mark.parametrize("gap", [1, 2, 3])
def test_rows_between_beams_are_filled_on_one_surface(gap):
    elevations = np.rad2deg(GRID.elevations_rad)
    azimuth = np.rad2deg(GRID.azimuths_rad[7])
    view = view_of(points_at([elevations[2], elevations[3 + gap]], [azimuth] * 2, [10.0, 10.8]))
    share = np.arange(1, gap + 1) / (gap + 1)
    np.testing.assert_allclose(view[3 : 3 + gap, 7], 10.0 + 0.8 * share, atol=1e-4)


def test_rows_between_beams_stay_empty_between_two_surfaces():
    elevations = np.rad2deg(GRID.elevations_rad)
    azimuth = np.rad2deg(GRID.azimuths_rad[7])
    view = view_of(points_at([elevations[2], elevations[4]], [azimuth] * 2, [10.0, 14.0]))
    assert view[3, 7] == 0


def test_wide_gaps_between_beams_stay_empty():
    elevations = np.rad2deg(GRID.elevations_rad)
    azimuth = np.rad2deg(GRID.azimuths_rad[7])
    view = view_of(points_at([elevations[1], elevations[6]], [azimuth] * 2, [10.0, 10.0]))
    assert not view[2:6].any()


def test_a_single_missing_column_is_filled_on_one_surface_only():
    step = 360.0 / GRID.around
    first = -180.0 + step * (GRID.around // 2)
    same = panorama_from_points(points_at([0, 0], [first, first + 2 * step], [10.0, 10.6]), GRID)
    other = panorama_from_points(points_at([0, 0], [first, first + 2 * step], [10.0, 12.0]), GRID)
    assert same[0, 4, GRID.around // 2 + 1] == pytest.approx(10.3, abs=1e-3)
    assert other[0, 4, GRID.around // 2 + 1] == 0


def test_an_empty_scan_gives_an_empty_panorama():
    assert not panorama_from_points(np.zeros((0, 4), np.float32), GRID).any()


def test_the_intensity_in_a_cell_is_that_of_the_point_whose_range_it_holds():
    elevation, azimuth = np.rad2deg(GRID.elevations_rad[4]), np.rad2deg(GRID.azimuths_rad[5])
    points = points_at([elevation + 1.5, elevation + 0.2], [azimuth] * 2, [7.0, 9.0], [0.9, 0.3])
    np.testing.assert_allclose(both_of(points)[:, 4, 5], [9.0, 0.3], atol=1e-4)


def test_rows_between_beams_are_filled_with_the_intensity_between():
    elevations = np.rad2deg(GRID.elevations_rad)
    points = points_at([elevations[2], elevations[4]], [np.rad2deg(GRID.azimuths_rad[7])] * 2, [10.0, 10.2], [0.2, 0.6])
    np.testing.assert_allclose(both_of(points)[:, 3, 7], [10.1, 0.4], atol=1e-4)


def test_intensity_has_no_cell_where_there_is_no_range():
    ranges, intensity = both_of(points_at(np.zeros(9), np.linspace(-40, 40, 9), np.linspace(30, 50, 9)))
    assert (intensity[ranges == 0] == 0).all()
    assert (intensity[ranges > 0] == 0.5).all()


def test_heights_count_from_the_ground_and_only_where_something_was_measured():
    ranges = np.zeros((9, 16), np.float32)
    ranges[0, 0], ranges[8, 1] = 10.0, 4.0
    heights = heights_of(ranges, 1.8, GRID)
    sine = np.sin(np.deg2rad(15))
    assert heights[0, 0] == pytest.approx(1.8 + 10 * sine, abs=1e-5)
    assert heights[8, 1] == pytest.approx(1.8 - 4 * sine, abs=1e-5)
    assert np.count_nonzero(heights) == 2


def test_planes_of_a_survey_view_have_no_colour_and_are_blank_in_rows_that_it_does_not_see():
    view = lidar_view(10.0)
    rows_seen = np.arange(9) > 2
    planes = dict(zip(PLANES, survey_planes(view, sensor_height_m=1.8, rows_seen=rows_seen, grid=GRID), strict=True))
    assert not planes["v1"].any()
    assert not planes["v2"].any()
    for name in ("range_m", "height_m", "observed", "brightness"):
        assert not planes[name][:3].any()
    assert (planes["observed"][3:] == 1).all()
    assert (planes["range_m"][3:] == 10).all()


def test_survey_planes_discard_ranges_beyond_the_limit():
    planes = survey_planes(lidar_view(41.0), sensor_height_m=1.8, rows_seen=np.ones(9, np.bool_), grid=GRID)
    assert not planes[[0, 3, 5]].any()


def lidar_view(range_m):
    rising = np.broadcast_to(np.linspace(0.1, 0.9, 16), (9, 16))
    return np.stack([np.full((9, 16), range_m), rising]).astype(np.float32)


def test_brightness_of_a_survey_view_rises_with_the_intensity():
    planes = survey_planes(lidar_view(10.0), sensor_height_m=1.8, rows_seen=np.ones(9, np.bool_), grid=GRID)
    assert (np.diff(planes[PLANES.index("brightness")], axis=1) > 0).all()


def plain_panorama(points, grid):
    """Compute a panorama as ``panorama_from_points``, with a sort of all points and with whole arrays instead of holes."""
    x, y, z, intensity = points.T
    flat = np.hypot(x, y)
    distance, elevation = np.hypot(flat, z), np.arctan2(z, flat)
    top, bottom = np.deg2rad(grid.elevation_top_deg), np.deg2rad(grid.elevation_bottom_deg)
    row_exact = (top - elevation) / (top - bottom) * (grid.rows - 1)
    column_exact = (np.arctan2(y, x) + np.pi) / (2 * np.pi) * grid.around
    row, column = np.rint(row_exact).astype(int), np.rint(column_exact).astype(int) % grid.around
    good = (row >= 0) & (row < grid.rows) & (distance >= grid.min_range_m) & (distance <= grid.max_range_m)
    off = np.abs(row_exact - row) + np.abs(column_exact - np.rint(column_exact))
    cells = np.zeros((2, grid.rows, grid.around), np.float32)
    for k in np.argsort(-off, kind="stable"):  # the nearest last, and of equally near ones the last
        if good[k]:
            cells[:, row[k], column[k]] = distance[k], intensity[k]
    for gap in (1, 2, 3):
        for offset in range(1, gap + 1):
            above, below = cells[:, : grid.rows - gap - 1], cells[:, gap + 1 :]
            hole = cells[:, offset : grid.rows - gap - 1 + offset]
            agree = (hole[0] == 0) & (above[0] > 0) & (below[0] > 0)
            agree &= np.abs(above[0] - below[0]) < (0.10 + 0.05 * gap) * np.minimum(above[0], below[0])
            share = np.float32(offset / (gap + 1))
            hole[:, agree] = (1 - share) * above[:, agree] + share * below[:, agree]
    left, right = np.roll(cells, 1, axis=2), np.roll(cells, -1, axis=2)
    agree = (cells[0] == 0) & (left[0] > 0) & (right[0] > 0)
    agree &= np.abs(left[0] - right[0]) < 0.10 * np.minimum(left[0], right[0])
    cells[:, agree] = 0.5 * (left[:, agree] + right[:, agree])
    return cells


@given(seed=st.integers(0, 10**6), count=st.sampled_from([0, 1, 40, 600]), rounded=st.booleans())
def test_a_panorama_is_numpys_to_the_bit(seed, count, rounded):
    """With rounded directions many points of a cell are equally near to its ray."""
    rng = np.random.default_rng(seed)
    elevation, azimuth = rng.uniform(-18, 18, count), rng.uniform(-180, 180, count)
    if rounded:
        elevation, azimuth = np.rint(elevation), 2 * np.rint(azimuth / 2)
    points = points_at(
        elevation, azimuth, rng.choice([0.2, 8.0, 9.0, 41.0], count) + rng.random(count), rng.random(count)
    )
    found, expected = panorama_from_points(points, GRID), plain_panorama(points, GRID)
    assert found.tobytes() == expected.tobytes()


@given(seed=st.integers(0, 10**6), headings=st.lists(st.floats(-7, 7), max_size=4))
def test_the_planes_of_a_fan_are_those_of_its_views(seed, headings):
    rng = np.random.default_rng(seed)
    panorama = panorama_from_points(
        points_at(rng.uniform(-18, 18, 400), rng.uniform(-180, 180, 400), rng.uniform(0.3, 45, 400), rng.random(400)),
        GRID,
    )
    rows_seen = rng.random(9) < 0.8
    found = fan_planes(panorama, np.array(headings), sensor_height_m=1.7, rows_seen=rows_seen, grid=GRID)
    assert found.shape == (len(headings), len(PLANES), 9, 16)
    for heading, planes in zip(headings, found, strict=True):
        view = view_from_panorama(panorama, heading, GRID)
        expected = survey_planes(view, sensor_height_m=1.7, rows_seen=rows_seen, grid=GRID)
        np.testing.assert_array_equal(planes, expected)


@pytest.mark.parametrize("share", [0.0, 0.002, 0.01, 0.1, 0.9])
@pytest.mark.parametrize("levels", [1, 2, 1000])
def test_the_brightness_of_a_fan_is_numpys_to_the_bit(share, levels):
    """Views of 4,096 cells with no measured cell, some, and most. With one level a view carries no information."""
    grid, rng = ViewGrid(), np.random.default_rng(levels)
    panorama = np.zeros((2, grid.rows, grid.around), np.float32)
    panorama[0] = np.where(rng.random(panorama[0].shape) < share, rng.uniform(1, 45, panorama[0].shape), 0)
    panorama[1] = (1 + rng.integers(0, levels, panorama[0].shape)) * rng.choice([1e-3, 7.0])
    rows_seen, headings = np.arange(grid.rows) != 5, np.linspace(-3, 3, 7)
    found = fan_planes(panorama, headings, sensor_height_m=1.7, rows_seen=rows_seen, grid=grid)
    for heading, planes in zip(headings, found, strict=True):
        ranges, intensity = view_from_panorama(panorama, heading, grid)
        inside = (ranges >= grid.min_range_m) & (ranges <= grid.max_range_m) & rows_seen[:, None]
        assert planes[5].tobytes() == brightness(intensity, measured=inside, seen=inside).tobytes()
        assert planes[0].tobytes() == (ranges * inside).tobytes()
        assert planes[3].tobytes() == heights_of(ranges * inside, 1.7, grid).tobytes()
        np.testing.assert_array_equal(planes[4], np.broadcast_to(rows_seen[:, None], ranges.shape))
        assert planes[5].any() == (share > 0.001 and levels > 1)


def test_a_dark_view_carries_no_brightness():
    """One view of the fan is dark, and the view after it is not."""
    panorama = np.full((2, 9, GRID.around), 10.0, np.float32)
    panorama[1] = np.linspace(1, 20, GRID.around)
    panorama[1, :, GRID.around // 4 : GRID.around // 2] = 0.0  # azimuths from -90 to 0 degrees
    headings = np.deg2rad([45.0, -45.0, 135.0])
    found = fan_planes(panorama, headings, sensor_height_m=1.8, rows_seen=np.ones(9, np.bool_), grid=GRID)
    assert [planes[5].any() for planes in found] == [True, False, True]
    assert (found[:, 0] == 10).all()


def test_the_order_of_a_panorama_in_memory_changes_nothing():
    panorama = np.random.default_rng(3).uniform(1, 40, (2, 9, GRID.around)).astype(np.float32)
    found, other = (
        fan_planes(each, np.array([0.0, 2.0]), sensor_height_m=1.8, rows_seen=np.ones(9, np.bool_), grid=GRID)
        for each in (panorama, np.asfortranarray(panorama))
    )
    np.testing.assert_array_equal(found, other)


@pytest.mark.parametrize(("rows", "columns", "seen"), [(0, -1, 0), (0, 1, 0), (1, 0, 1)])
def test_a_measurement_of_another_grid_is_refused(rows, columns, seen):
    """With a narrower panorama, the C code would read and write outside of its arrays."""
    rows_seen = np.ones(GRID.rows + seen, np.bool_)
    panorama = np.ones((2, GRID.rows + rows, GRID.around + columns), np.float32)
    view = np.ones((2, GRID.rows + rows, GRID.columns + columns), np.float32)
    with pytest.raises(ValueError, match="is not one of the view grid: give "):
        fan_planes(panorama, np.zeros(1), sensor_height_m=1.8, rows_seen=rows_seen, grid=GRID)
    with pytest.raises(ValueError, match="is not one of the view grid: give "):
        survey_planes(view, sensor_height_m=1.8, rows_seen=rows_seen, grid=GRID)
