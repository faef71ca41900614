"""Dynamic objects between passes: a street computed by hand, and a simulated one."""

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from model_training.mapping import passes, work
from model_training.mapping.passes import MOST, Passes, Targets, Vote, looked_through, tile_of, tiles_within
from model_training.mapping.settings import BuildSettings
from model_training.mapping.voxel_map import VoxelMap
from model_training.mapping.work import BuildCache
from service.geometry.rigid import transform_from, transform_points

SETTINGS = BuildSettings(name="street", spacing_m=4.0, calibration=None, align_survey=False)
LIDAR_M = 1.8
BOX = (np.array([27.0, 3.0, 0.0]), np.array([31.0, 4.8, 1.5]))  # a parked car
POLE = (np.array([40.0, 5.0, 0.0]), np.array([40.08, 5.08, 4.0]))
WALL_Y = 8.0


def along(x_m):
    """Return a LiDAR pose at each x, 1.8 m above the ground."""
    return np.stack([transform_from(np.eye(3), np.array([x, 0.0, LIDAR_M])) for x in x_m])


def drive(count):
    """Return a drive that passes the same street of 60 m several times in one direction."""
    return np.concatenate([along(np.arange(0.0, 61.0, 4.0))] * count)


def scan_of(T, *, car, van=None):
    """Return 64 beams x 720 directions in the LiDAR frame: ground, a wall at y = 8 m, a pole, a parked car and a van."""
    azimuth, elevation = np.meshgrid(np.arange(720) / 720 * 2 * np.pi, np.deg2rad(np.linspace(-25, 10, 64)))
    flat = np.cos(elevation)
    ray = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=-1).reshape(-1, 3)
    at = T[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        ground = np.where(ray[:, 2] < 0, -at[2] / ray[:, 2], np.inf)
        wall = np.where(ray[:, 1] > 0, (WALL_Y - at[1]) / ray[:, 1], np.inf)
        wall = np.where(at[2] + wall * ray[:, 2] < 6.0, wall, np.inf)
        ranges = np.minimum(ground, wall)
        for low, high in [POLE, *([BOX] if car else []), *([van] if van else [])]:
            first, second = (low - at) / ray, (high - at) / ray
            enters, leaves = np.minimum(first, second).max(axis=1), np.maximum(first, second).min(axis=1)
            ranges = np.minimum(ranges, np.where((enters <= leaves) & (enters > 0), enters, np.inf))
    seen = ranges < 60.0
    return np.c_[ray[seen] * ranges[seen, None], np.zeros(seen.sum())].astype(np.float32)


def moved(cloud, dataset, poses, folder, *, earlier=None, each_scan=False):
    """Return the keys of the voxels that a vote of all scans removes, with chunks stored in a folder."""
    vote = Vote.of(cloud, dataset, poses, np.arange(len(poses)), SETTINGS, each_scan=each_scan)
    return vote.removed(BuildCache(folder, "k").chunks("votes", len(poses), vote.votes), earlier)


def voted(tmp_path, *, cars, earlier=None):
    """Drive the street once for each flag of ``cars``; return the cloud before and after the vote."""
    poses = drive(len(cars))
    each = len(poses) // len(cars)
    dataset: Any = SimpleNamespace(scan=lambda number: scan_of(poses[number], car=cars[number // each]))
    cloud = VoxelMap(0.3, np.zeros(3))
    for number, T in enumerate(poses):
        points = dataset.scan(number)[:, :3].astype(np.float64)
        cloud.add(transform_points(T, points[np.linalg.norm(points, axis=1) < 40.0]))
    known = None if earlier is None else cloud.keys_of(earlier)
    gone = moved(cloud, dataset, poses, tmp_path, earlier=known)
    before = cloud.means()
    removed = np.isin(cloud.sums()[0], gone)
    return before, removed


def inside(points, box, *, rim=0.15):
    low, high = box
    return ((points > low - rim) & (points < high + rim)).all(axis=1) & (points[:, 2] > 0.35)


@pytest.fixture(scope="module")
def one_of_three(tmp_path_factory):
    return voted(tmp_path_factory.mktemp("work"), cars=[True, False, False])


def test_a_car_of_one_pass_in_three_vanishes(one_of_three):
    points, removed = one_of_three
    car = inside(points, BOX)
    assert car.sum() > 50
    assert removed[car].mean() > 0.9


def test_wall_pole_and_ground_stay(one_of_three):
    points, removed = one_of_three
    wall = np.abs(points[:, 1] - WALL_Y) < 0.15
    pole = inside(points, POLE)
    ground = np.abs(points[:, 2]) < 0.1
    assert wall.sum() > 1000
    assert pole.sum() >= 8
    assert ground.sum() > 5000
    assert not removed[wall].any()
    assert not removed[pole].any()
    assert not removed[ground].any()


def test_a_car_of_two_passes_in_three_stays(tmp_path):
    points, removed = voted(tmp_path, cars=[True, True, False])
    assert not removed[inside(points, BOX)].any()


def test_one_pass_against_one_decides_nothing(tmp_path):
    assert not voted(tmp_path, cars=[True, False])[1].any()


def test_a_single_pass_decides_nothing(tmp_path):
    assert not voted(tmp_path, cars=[True])[1].any()


def test_dynamic_objects_of_a_single_pass_are_removed_and_static_ones_stay(tmp_path):
    """A van drives 10 m ahead in the right lane. The parked car is in every scan."""
    poses = along(np.arange(0.0, 41.0, 2.0))
    vans = [(np.array([x + 10.0, -4.0, 0.3]), np.array([x + 14.0, -2.0, 2.3])) for x in poses[:, 0, 3]]
    dataset: Any = SimpleNamespace(scan=lambda number: scan_of(poses[number], car=True, van=vans[number]))
    cloud = VoxelMap(0.3, np.zeros(3))
    for number, T in enumerate(poses):
        points = dataset.scan(number)[:, :3].astype(np.float64)
        cloud.add(transform_points(T, points[np.linalg.norm(points, axis=1) < 40.0]))
    gone = moved(cloud, dataset, poses, tmp_path, each_scan=True)
    points, removed = cloud.means(), np.isin(cloud.sums()[0], gone)
    lane = (points[:, 1] < -1.8) & (points[:, 1] > -4.2) & (points[:, 2] > 0.5)
    seen_later = lane & (points[:, 0] > 12.0) & (points[:, 0] < 38.0)  # where the last van stands nobody looked later
    assert seen_later.sum() > 100
    assert removed[seen_later].mean() > 0.79
    stands = (
        (np.abs(points[:, 1] - WALL_Y) < 0.15)
        | inside(points, POLE)
        | inside(points, BOX)
        | (np.abs(points[:, 2]) < 0.1)
    )
    assert stands.sum() > 5000
    assert removed[stands].mean() < 0.002


def test_two_new_passes_overrule_the_map(tmp_path_factory):
    """The map has a car that neither of two new passes hits. The map counts as one pass, so one new pass is not enough."""
    rng = np.random.default_rng(0)
    sides = rng.uniform(BOX[0], BOX[1], (4000, 3))
    sides[:, 1] = BOX[0][1]  # the side that looks at the street
    for new_passes, share in ((2, 0.8), (1, 0.0)):
        poses = drive(new_passes)
        dataset: Any = SimpleNamespace(scan=lambda number, poses=poses: scan_of(poses[number], car=False))
        cloud = VoxelMap(0.3, np.zeros(3))
        cloud.add(sides)
        earlier = cloud.sums()[0].copy()
        for number, T in enumerate(poses):
            cloud.add(transform_points(T, dataset.scan(number)[:, :3].astype(np.float64)))
        gone = moved(cloud, dataset, poses, tmp_path_factory.mktemp("work"), earlier=earlier)
        above = cloud.means()[np.isin(cloud.sums()[0], earlier)][:, 2] > 0.35
        found = np.isin(cloud.sums()[0][np.isin(cloud.sums()[0], earlier)], gone)[above].mean()
        assert found >= share
        assert share > 0 or found == 0


def test_the_votes_of_finished_scans_are_kept(tmp_path, monkeypatch):
    monkeypatch.setattr(work, "CHUNK", 10)
    first = voted(tmp_path, cars=[True, False, False])[1]
    monkeypatch.setattr(passes, "looked_through", lambda *_: pytest.fail("it was finished"))
    np.testing.assert_array_equal(voted(tmp_path, cars=[True, False, False])[1], first)


def test_passes_count_up_where_a_tile_comes_into_reach_again():
    """The drive goes out to 200 m and back, every 2 m: two passes near the start, one at the turn. First visits have number 0."""
    x = np.r_[np.arange(0.0, 201.0, 2.0), np.arange(198.0, -1.0, -2.0)]
    found = Passes.of(along(x))
    at = {place: tile_of(np.array([[place, 0.0, 0.0]]))[0] for place in (5.0, 195.0)}
    number = {
        (scan, place): found.number[scan][found.tiles[scan] == at[place]].tolist()
        for scan in (0, 100, len(x) - 1)
        for place in at
    }
    assert number[0, 5.0] == [0]
    assert number[0, 195.0] == []  # out of reach
    assert number[100, 195.0] == [0]
    assert number[len(x) - 1, 5.0] == [1]
    turned = np.flatnonzero((found.tiles == at[195.0]).any(axis=1))
    assert set(found.number[turned][found.tiles[turned] == at[195.0]].tolist()) == {0}


def test_passes_beyond_the_last_bit_count_as_one():
    found = Passes.of(np.concatenate([along([0.0, 500.0])] * 80), spacing_m=1.0)
    here = tile_of(np.zeros((1, 3)))[0]
    numbers = found.number[::2][found.tiles[::2] == here]
    np.testing.assert_array_equal(numbers, np.minimum(np.arange(80), MOST))


def test_bits_are_nothing_out_of_reach():
    found = Passes.of(along([0.0]))
    tiles = tile_of(np.array([[0.0, 0.0], [500.0, 0.0]]))
    assert found.bits(0, tiles).tolist() == [1, 0]


#: A direction in the middle of a cell of the range image.
AHEAD = np.array([1.0, 0.004, 0.004])


def cloud_of(positions):
    """Return a voxel map with a point at each position."""
    cloud = VoxelMap(0.3, np.array([30.0, -20.0, 5.0]))
    cloud.add(np.array(positions))
    return cloud


def targets_at(position, normal):
    return Targets.at(cloud_of([position]), np.zeros(1, np.int32), np.array([normal], np.float32))


def test_targets_are_found_by_tile_and_by_point():
    """Rows 0, 1 and 3 have a surface, and row 2 has none. Row 3 lies in another tile."""
    cloud = cloud_of([[0.5, 0.5, 0.0], [1.5, 1.5, 0.0], [2.5, 2.5, 0.0], [25.5, 0.5, 0.0]])
    found = Targets.at(cloud, np.array([0, 1, 3], np.int32), np.ones((4, 3), np.float32))
    here, there, nowhere = tile_of(np.array([[0.0, 0.0], [25.0, 0.0], [-500.0, 0.0]]))
    assert found.of_tiles(np.array([here])).tolist() == [0, 1]
    assert found.of_tiles(np.sort([here, there, nowhere])).tolist() == [0, 1, 3]
    assert found.of_tiles(np.array([nowhere])).tolist() == []
    points = np.array([[25.6, 0.6, 0.1], [1.5, 1.4, 0.1], [2.5, 2.5, 0.0], [1.4, 1.5, 0.0], [9.0, 9.0, 0.0]])
    assert found.at_points(points).tolist() == [1, 3]
    assert found.numbers_of(np.array([0, 1, 3])).tolist() == [here, here, there]


def test_a_map_without_surfaces_has_no_targets():
    found = Targets.of(VoxelMap(0.3, np.zeros(3)))
    assert found.of_tiles(tile_of(np.zeros((1, 3)))).tolist() == []
    assert found.at_points(np.zeros((1, 3))).tolist() == []


def test_tiles_within_reach_are_those_with_a_point_in_reach():
    """From (5, 5), in the tile of the corner (0, 0)."""
    tiles = tile_of(
        np.array([[5.0, 5.0], [15.0, 5.0], [25.0, 5.0], [35.0, 5.0], [-25.0, 5.0], [25.0, 25.0], [15.0, 25.0]])
    )
    found = tiles_within(tiles, np.array([5.0, 5.0]), 20.0)  # distances: 0, 5, 15, 25, 25, 21.2 and 15.8 m
    assert found.tolist() == [True, True, True, False, False, False, True]
    assert tiles_within(tiles[4:5], np.array([5.0, 5.0]), 24.9).tolist() == [False]
    assert tiles_within(tiles[4:5], np.array([5.0, 5.0]), 25.1).tolist() == [True]


@pytest.mark.parametrize(
    ("end_m", "normal", "through"),
    [
        (20.0, (1.0, 0.0, 0.0), True),  # the ray goes on for 10 m
        (10.7, (1.0, 0.0, 0.0), True),
        (10.5, (1.0, 0.0, 0.0), False),  # less than two voxels behind
        (8.0, (1.0, 0.0, 0.0), False),  # something stands before it
        (20.0, (0.0, 0.0, 1.0), False),  # the ray ends on the voxel's own plane
    ],
)
def test_one_ray_by_hand(end_m, normal, through):
    targets = targets_at(10.0 * AHEAD, normal)
    found = looked_through(targets, np.zeros(1, np.int32), end_m * AHEAD[None], np.eye(4), behind_m=0.6)
    assert found.tolist() == ([0] if through else [])


def test_a_ray_beside_it_that_ends_before_it_saves_it():
    beside = 9.9 * np.array([np.cos(0.006), np.sin(0.006), 0.0])
    points = np.array([20.0 * AHEAD, beside])
    targets = targets_at(10.0 * AHEAD, (1.0, 0.0, 0.0))
    assert looked_through(targets, np.zeros(1, np.int32), points, np.eye(4), behind_m=0.6).tolist() == []


def test_where_no_ray_goes_there_is_no_vote():
    targets = targets_at(10.0 * AHEAD, (1.0, 0.0, 0.0))
    points = np.array([[0.0, 20.0, 0.0]])
    assert looked_through(targets, np.zeros(1, np.int32), points, np.eye(4), behind_m=0.6).tolist() == []


def test_an_empty_scan_looks_through_nothing():
    targets = targets_at(10.0 * AHEAD, (1.0, 0.0, 0.0))
    assert looked_through(targets, np.zeros(1, np.int32), np.zeros((0, 3)), np.eye(4), behind_m=0.6).tolist() == []


def slow_looked_through(targets, points, T_map_lidar, behind_m):
    """Test voxel by voxel: the nearest point of each cell of half a degree, and the least range of a cell and the eight around it."""

    def cell(p):
        elevation, azimuth = np.rad2deg(np.arcsin(p[2] / np.linalg.norm(p))), np.rad2deg(np.arctan2(p[1], p[0]))
        return int(np.floor((elevation + 45) / 0.5)), int(np.floor((azimuth + 180) / 0.5)) % 720

    nearest = {}
    for p in points:
        row, column = cell(p)
        if np.linalg.norm(p) > 2 and 0 <= row < 180:
            old = nearest.get((row, column))
            if old is None or np.linalg.norm(p) <= np.linalg.norm(old):
                nearest[row, column] = p
    found = []
    for k, (position, normal) in enumerate(zip(targets.cloud.means(), targets.normals, strict=True)):
        p = (position - T_map_lidar[:3, 3]) @ T_map_lidar[:3, :3]
        away = np.linalg.norm(p)
        row, column = cell(p)
        if not 2 < away <= passes.REACH_M or (row, column) not in nearest:
            continue
        around = [nearest.get((row + a, (column + b) % 720)) for a in (-1, 0, 1) for b in (-1, 0, 1)]
        least = min(np.linalg.norm(each) for each in around if each is not None)
        end = nearest[row, column] @ T_map_lidar[:3, :3].T + T_map_lidar[:3, 3]
        if least >= away * 1.01 + behind_m and abs((end - position) @ normal) > targets.cloud.voxel_m:
            found.append(k)
    return found


@pytest.mark.parametrize("seed", range(4))
def test_the_compiled_vote_is_that_of_a_slow_loop(seed):
    rng = np.random.default_rng(seed)
    turn = Rotation.random(random_state=seed).as_matrix()
    T_map_lidar = transform_from(turn, rng.uniform(-50, 50, 3))
    # Rays in a narrow sector, so that many cells have neighbours, and voxels on some of them.
    azimuth, elevation = np.deg2rad(rng.uniform(170, 190, 900)), np.deg2rad(rng.uniform(-8, 8, 900))
    rays = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=1
    )
    points = rays * rng.choice([1.5, 12.0, 25.0, 60.0], (900, 1), p=[0.05, 0.1, 0.45, 0.4])
    positions = transform_points(T_map_lidar, rays[:400] * rng.uniform(1.0, 35.0, (400, 1)))
    normals = rng.normal(size=(400, 3)).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    cloud = cloud_of(positions)
    rows = np.arange(len(cloud.sums()[0]), dtype=np.int32)
    targets = Targets.at(cloud, rows, normals[rows])
    found = looked_through(targets, rows, points, T_map_lidar, behind_m=0.6)
    expected = slow_looked_through(targets, points, T_map_lidar, 0.6)
    assert 50 < len(expected) < 390
    assert found.tolist() == expected


def cell_by_hand(point):
    """Return the cell of half a degree of a direction, by the functions of the C library, as the vote states it."""
    x, y, z = point
    row = math.floor((math.asin(z / math.sqrt(x * x + y * y + z * z)) * 57.29577951308232 + 45.0) / 0.5)
    return row, math.floor((math.atan2(y, x) * 57.29577951308232 + 180.0) / 0.5) % 720


@pytest.mark.parametrize("azimuth_deg", [-180.0, -135.0, -90.0, -44.5, 0.0, 30.5, 45.0, 90.0, 134.5, 179.5])
@pytest.mark.parametrize("elevation_deg", [-45.0, -15.0, 0.0, 0.5, 14.5, 44.5])
def test_rays_on_the_limits_of_cells_belong_to_the_cell_of_the_c_library(azimuth_deg, elevation_deg):
    """A ray a few roundings beside a corner of four cells. It sees through the voxel in the middle of its own cell only."""
    azimuth, elevation = np.deg2rad(azimuth_deg), np.deg2rad(elevation_deg)
    middles = [
        (np.deg2rad(elevation_deg + up), np.deg2rad(azimuth_deg + left))
        for up in (-0.25, 0.25)
        for left in (-0.25, 0.25)
    ]
    rays = np.array([[np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)] for e, a in middles])
    cloud = VoxelMap(0.001, np.zeros(3))  # each voxel in a cell of its own, a point in each
    cloud.add(8.0 * rays)
    targets = Targets.at(cloud, np.arange(4, dtype=np.int32), np.zeros((4, 3), np.float32))
    targets.normals[:] = (rays[0] + rays[3]).astype(np.float32)
    cells = [cell_by_hand(mean) for mean in cloud.means()]
    for ulps in range(-3, 4):
        point = 20.0 * np.array(
            [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
        )
        for _ in range(abs(ulps)):
            point = np.nextafter(point, np.copysign(np.inf, ulps))
        row, column = cell_by_hand(point)
        expected = [k for k, cell in enumerate(cells) if cell == (row, column) and 0 <= row < 180]
        found = looked_through(targets, np.arange(4, dtype=np.int32), point[None], np.eye(4), behind_m=0.6)
        assert found.tolist() == expected


def test_vertical_rays_and_rays_along_the_axes_have_a_cell_or_none():
    points = 20.0 * np.array(
        [[0, 0, 1], [0, 0, -1], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [-1, -0.0, 0], [0, 0, 0]]
    )
    for point in points.astype(np.float64):
        voxel = 0.5 * point + [0.01, 0.02, 0.03]
        cloud = VoxelMap(0.3, np.zeros(3))
        cloud.add(voxel[None])
        targets = Targets.at(cloud, np.zeros(1, np.int32), np.array([[0.6, 0.0, 0.8]], np.float32))
        found = looked_through(targets, np.zeros(1, np.int32), point[None], np.eye(4), behind_m=0.6)
        assert found.tolist() == (slow_looked_through(targets, point[None], np.eye(4), 0.6) if point.any() else [])


def test_voxels_out_of_reach_are_not_seen_through():
    """Along a ray of 60 m, voxels of 0.3 m in steps of 0.1 m around the least and the largest range."""
    for ranges in (np.arange(1.0, 3.0, 0.1), np.arange(29.0, 31.5, 0.1)):
        cloud = cloud_of(ranges[:, None] * AHEAD)
        rows = np.arange(len(cloud.sums()[0]), dtype=np.int32)
        targets = Targets.at(cloud, rows, np.tile(np.array([1, 0, 0], np.float32), (len(rows), 1)))
        found = looked_through(targets, rows, 60.0 * AHEAD[None], np.eye(4), behind_m=0.6)
        away = np.linalg.norm(cloud.means(), axis=1)
        assert found.tolist() == np.flatnonzero((away > 2.0) & (away <= passes.REACH_M)).tolist()
        assert 0 < len(found) < len(rows)
