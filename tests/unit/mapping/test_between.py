import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from model_training.mapping.between import FARTHEST_M, PlacedScan, PlannedPlaces, at_scan, shares_on_way, viewpoint_at
from model_training.mapping.survey import LevelledScan
from service.geometry.rigid import inverse, rotation_z, transform_from, transform_points
from service.imaging.pca import Level

#: Two points of a wall and one of the ground, map frame, metres.
POINTS_MAP = np.array([[4.0, 3.0, 2.0], [8.0, 3.0, 2.5], [6.0, -1.0, 0.0]])


def placed(x_m, *, yaw_rad=0.0, height_m=1.7, intensity=10.0):
    """Return a scan of ``POINTS_MAP`` from a pose on the x axis."""
    T_map_level = transform_from(rotation_z(yaw_rad), np.array([x_m, 0.0, height_m]))
    points = np.c_[transform_points(inverse(T_map_level), POINTS_MAP), np.full(3, intensity)].astype(np.float32)
    level = Level(np.eye(3), height_m)
    return PlacedScan(LevelledScan(0, points, level, 0.0), T_map_level)


def between(one, other, largest_m):
    """Return the viewpoints between two scans in the middle of a traversal."""
    way = np.stack([one.T_map_level, one.T_map_level, other.T_map_level, other.T_map_level])
    return [viewpoint_at(one, other, share) for share in shares_on_way(way, 2, largest_m)]


def beyond(one, end, largest_m):
    """Return the viewpoints behind the end of a traversal, which the second scan is."""
    way = np.stack([one.T_map_level, one.T_map_level, end.T_map_level])
    return [viewpoint_at(one, end, share) for share in shares_on_way(way, 2, largest_m) if share > 1]


def test_a_place_half_way_has_the_mean_pose_and_the_points_of_both_scans():
    (found,) = between(
        placed(2.0, height_m=1.6, intensity=10.0), placed(6.0, yaw_rad=0.2, height_m=1.8, intensity=20.0), 3.0
    )
    np.testing.assert_allclose(
        found.T_map_level, transform_from(rotation_z(0.1), np.array([4.0, 0.0, 1.7])), atol=1e-12
    )
    assert found.height_m == pytest.approx(1.7)
    np.testing.assert_allclose(
        transform_points(found.T_map_level, found.points[:, :3].astype(np.float64)),
        np.tile(POINTS_MAP, (2, 1)),
        atol=1e-5,
    )
    assert found.points[:, 3].tolist() == [10.0] * 3 + [20.0] * 3


@pytest.mark.parametrize(
    ("apart_m", "largest_m", "at_m"),
    [
        (3.0, 3.0, []),
        (3.1, 3.0, [1.55]),
        (9.0, 3.0, [3.0, 6.0]),
        (9.3, 3.0, [2.325, 4.65, 6.975]),
        (9.0, 0.0, []),  # switched off
        (FARTHEST_M + 0.1, 3.0, []),  # scans of two traversals
        (0.0, 3.0, []),
    ],
)
def test_places_are_spread_evenly_on_the_way(apart_m, largest_m, at_m):
    found = between(placed(1.0), placed(1.0 + apart_m), largest_m)
    assert [each.T_map_level[0, 3] - 1.0 for each in found] == pytest.approx(at_m)


@given(st.floats(0.01, FARTHEST_M), st.floats(0.2, 20.0))
def test_no_gap_exceeds_the_largest_distance(apart_m, largest_m):
    one, other = placed(0.0), placed(apart_m)
    x_m = [0.0, *(each.T_map_level[0, 3] for each in between(one, other, largest_m)), apart_m]
    assert np.diff(x_m).max() <= largest_m + 1e-9
    assert np.diff(x_m).min() > 0


@pytest.mark.parametrize(
    ("apart_m", "at_m"), [(3.0, []), (4.0, [2.0, 4.0]), (9.0, [3.0, 6.0, 9.0]), (FARTHEST_M + 0.1, [])]
)
def test_the_way_goes_straight_on_for_one_more_distance_at_its_end(apart_m, at_m):
    one, end = placed(0.0, height_m=1.8), placed(apart_m, yaw_rad=0.2, height_m=1.8)
    found = beyond(one, end, 3.0)
    assert [each.T_map_level[0, 3] - apart_m for each in found] == pytest.approx(at_m)
    for each in found:
        np.testing.assert_allclose(each.T_map_level[:3, :3], rotation_z(0.2), atol=1e-12)
        assert each.height_m == 1.8
        points_map = transform_points(each.T_map_level, each.points[:, :3].astype(np.float64))
        np.testing.assert_allclose(points_map, np.tile(POINTS_MAP, (2, 1)), atol=1e-5)


def test_the_beginning_of_a_way_goes_on_backwards():
    first, second = placed(0.0, height_m=1.7), placed(4.0, height_m=1.7)
    way = np.stack([first.T_map_level, second.T_map_level, second.T_map_level])
    found = [viewpoint_at(first, second, share) for share in shares_on_way(way, 1, 3.0) if share < 0]
    assert [each.T_map_level[0, 3] for each in found] == pytest.approx([-2.0, -4.0])


def test_each_scan_becomes_a_place_and_each_gap_is_planned_once():
    way = np.stack([placed(x_m).T_map_level for x_m in (0.0, 4.0, 6.0, 10.0, 40.0, 44.0)])
    plan = PlannedPlaces.of(way, 3.0)
    assert plan.at_scan.all()
    assert dict(plan.on_way) == {1: (0.5, -0.5, -1.0), 3: (0.5, 1.5, 2.0), 5: (0.5, -0.5, -1.0, 1.5, 2.0)}


def test_a_place_at_a_scan_is_the_scan():
    scan = placed(2.0)
    found = at_scan(scan)
    assert found.points is scan.scan.points
    assert (found.height_m, found.start_rad) == (1.7, 0.0)
    np.testing.assert_array_equal(found.T_map_level, scan.T_map_level)
