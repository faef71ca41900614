import sys

import numpy as np
import pytest
import torch

from research.baselines.regression import refine
from research.baselines.regression.clouds import depth_points, map_points_in_view
from research.baselines.regression.lucas_kanade import transform_of
from research.baselines.regression.map_cloud import MapCloud, make_map_cloud
from research.baselines.regression.pointnet import PointNet
from research.baselines.regression.refine import by_icp, by_pointnet_lk, share_on_map
from service.errors import ExtraMissingError
from service.geometry.rigid import inverse, transform_points


@pytest.fixture(scope="module")
def query(pairs_in_hall):
    pairs = pairs_in_hall(12)
    row = int(np.argmin(np.abs(pairs.T_map_camera[:, 0, 3] - 30)))
    return depth_points(pairs, row), pairs.T_map_camera[row], pairs.camera


@pytest.fixture(scope="module")
def net():
    torch.manual_seed(3)
    return PointNet().eval()


def off_by(T, *twist):
    return T @ transform_of(torch.tensor(twist, dtype=torch.float64)).numpy()


def test_depth_becomes_points_on_the_map_s_surfaces(query, hall):
    points, T_map_camera, _ = query
    points_map = transform_points(T_map_camera, points)
    apart = [np.linalg.norm(hall.points_map - point, axis=1).min() for point in points_map[::20]]
    assert np.median(apart) < 0.3


def test_a_camera_shows_what_is_in_front_of_it(query, hall):
    _, T_map_camera, camera = query
    seen = map_points_in_view(hall, T_map_camera, camera)
    assert len(seen) > 200
    assert (np.abs(seen[:, 0]) <= seen[:, 2] * 1.01).all()
    assert (np.linalg.norm(seen, axis=1) < 30.0).all()


def test_surfaces_behind_a_wall_are_not_shown(query, hall):
    _, T_map_camera, camera = query
    behind = transform_points(T_map_camera, np.random.default_rng(0).uniform([-2, -1, 20], [2, 1, 25], (300, 3)))
    wall = transform_points(T_map_camera, np.random.default_rng(1).uniform([-3, -3, 10], [3, 3, 10.1], (5000, 3)))
    seen = map_points_in_view(MapCloud(np.r_[behind, wall]), T_map_camera, camera)
    assert len(seen) > 1000
    assert (seen[:, 2] < 11).all()


def test_points_around_are_those_of_a_slow_search(hall):
    at = np.array([20.0, 12.0, 1.0])
    near = np.linalg.norm(hall.points_map - at, axis=1) < 7.0
    found = hall.around(at, 7.0)
    assert sorted(map(tuple, found)) == sorted(map(tuple, hall.points_map[near]))


def test_icp_recovers_a_known_transform(query, hall):
    points, T_map_camera, _ = query
    found = by_icp(hall, points, off_by(T_map_camera, 0.5, 0.1, -0.6, 0.01, 0.06, -0.01))
    assert found.registered
    np.testing.assert_allclose(found.T_map_camera[:3, 3], T_map_camera[:3, 3], atol=0.1)
    np.testing.assert_allclose(found.T_map_camera[:3, :3], T_map_camera[:3, :3], atol=0.01)


@pytest.mark.parametrize("case", ["far away", "few points", "empty map"])
def test_icp_keeps_the_pose_where_it_cannot_register(query, hall, case):
    points, T_map_camera, _ = query
    T = T_map_camera.copy()
    if case == "far away":
        T[0, 3] += 300.0
    cloud = MapCloud(np.zeros((0, 3))) if case == "empty map" else hall
    found = by_icp(cloud, points[:10] if case == "few points" else points, T)
    assert not found.registered
    np.testing.assert_array_equal(found.T_map_camera, T)


def test_icp_keeps_the_pose_where_too_few_points_fit(query, hall):
    """Random points are near some wall."""
    _, T_map_camera, _ = query
    strewn = np.random.default_rng(0).uniform([-10, -5, 1], [10, 1, 20], (800, 3))
    found = by_icp(hall, strewn, T_map_camera)
    assert not found.registered


def test_pointnet_lk_aligns_the_points_with_the_map(query, net, monkeypatch):
    """Untrained features suffice if the map shows exactly these points."""
    points, T_map_camera, camera = query
    points = points[:: len(points) // refine.LK_POINTS][: refine.LK_POINTS]
    wrong = off_by(T_map_camera, 0.4, 0.0, 0.4, 0.0, 0.03, 0.0)
    shown = transform_points(inverse(wrong) @ T_map_camera, points)
    monkeypatch.setattr(refine, "map_points_in_view", lambda *_: shown)
    found = by_pointnet_lk(net, MapCloud(transform_points(T_map_camera, points)), points, wrong, camera)
    assert found.registered
    np.testing.assert_allclose(found.T_map_camera[:3, 3], T_map_camera[:3, 3], atol=0.1)


def test_pointnet_lk_keeps_the_pose_where_its_own_fits_the_map_worse(query, hall, net, monkeypatch):
    """The given map points are 3 m ahead of their true position."""
    points, T_map_camera, camera = query
    points = points[:: len(points) // refine.LK_POINTS][: refine.LK_POINTS]
    monkeypatch.setattr(refine, "map_points_in_view", lambda *_: points + [0.0, 0.0, 3.0])
    found = by_pointnet_lk(net, hall, points, T_map_camera, camera)
    assert not found.registered
    np.testing.assert_array_equal(found.T_map_camera, T_map_camera)


def test_points_on_the_map_are_counted_within_a_metre(query):
    points, T_map_camera, _ = query
    own = MapCloud(transform_points(T_map_camera, points))
    assert share_on_map(own, np.r_[points, points + 500.0], T_map_camera) == 0.5


def test_pointnet_lk_keeps_the_pose_where_the_map_shows_nothing(query, hall, net):
    points, T_map_camera, camera = query
    away = off_by(T_map_camera, 0.0, 0.0, 500.0, 0.0, 0.0, 0.0)
    found = by_pointnet_lk(net, hall, points, away, camera)
    assert not found.registered
    np.testing.assert_array_equal(found.T_map_camera, away)


def test_pointnet_lk_keeps_the_pose_where_features_are_no_numbers(query, hall, net):
    points, T_map_camera, camera = query
    broken = PointNet()
    with torch.no_grad():
        next(broken.layers.parameters()).fill_(float("nan"))
    found = by_pointnet_lk(broken, hall, points, T_map_camera, camera)
    assert not found.registered


def test_the_map_cloud_is_made_once(small_dataset, tmp_path):
    cache, calls = tmp_path / "cloud.npy", []
    made = make_map_cloud(small_dataset, cache, report=lambda *each: calls.append(each))
    assert calls[-1] == ("map cloud", 11, 11)  # two of the twelve scans stand within a metre
    calls.clear()
    again = make_map_cloud(small_dataset, cache, report=lambda *each: calls.append(each))
    assert not calls
    np.testing.assert_array_equal(made.points_map, again.points_map)
    T = small_dataset.survey_poses()[0]
    scan_map = transform_points(T, small_dataset.scan(0)[:200, :3].astype(np.float64))
    near = scan_map[np.linalg.norm(scan_map - T[:3, 3], axis=1) < 50]
    for point in near[::20]:
        assert np.linalg.norm(made.points_map - point, axis=1).min() < 0.6


def test_without_small_gicp_the_extra_is_named(query, hall, monkeypatch):
    points, T_map_camera, _ = query
    monkeypatch.setitem(sys.modules, "small_gicp", None)
    with pytest.raises(ExtraMissingError, match=r"\.\[mapping\]"):
        by_icp(hall, points, T_map_camera)
