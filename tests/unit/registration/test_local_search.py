from dataclasses import replace

import numpy as np
import pytest

from service.geometry.rigid import rotation_z
from service.registration.local_search import LocalSearchSettings, search_locally
from service.registration.register import Registered, RegistrationSettings

TRUE_M, TURN = np.array([0.7, -0.4, 1.5]), np.deg2rad(8.0)
AROUND = LocalSearchSettings()


@pytest.fixture(scope="module")
def city(street):
    return street.survey(origin=(100.0, -50.0, 0.0))


@pytest.fixture(scope="module")
def points(street):
    return street.points(rotation_z(TURN), TRUE_M)


def around_of(city, points, found, **changed):
    return search_locally(city, points, found, TRUE_M[2], RegistrationSettings(), replace(AROUND, **changed))


def found_at(along=0.0, across=0.0, turn=0.0):
    R = rotation_z(TURN)
    return Registered(R @ rotation_z(turn), TRUE_M + R @ [along, across, 0.0], 1.0, 0.0, 0.4, np.eye(8), 7)


def away(near):
    return np.array([np.linalg.norm(each.pose.camera_m - TRUE_M) for each in near])


@pytest.mark.parametrize("off", [{"along": 1.6}, {"along": -1.5}, {"across": 0.9}, {"across": -0.9, "turn": 0.1}])
def test_a_local_search_from_another_local_minimum_finds_the_true_pose(city, points, off):
    """From there, the solver itself does not reach it within its two iterations."""
    settings = RegistrationSettings()
    few = replace(settings, fine=replace(settings.fine, iterations=2))
    start = found_at(**off)
    near = search_locally(city, points, start, TRUE_M[2], few, AROUND)
    assert near[0].pose is start
    assert away(near)[0] > 0.8
    best = max(near, key=lambda each: each.static_inliers)
    assert np.linalg.norm(best.pose.camera_m - TRUE_M) < 0.25
    assert best.static_inliers > near[0].static_inliers + 0.2
    assert (best.pose.hypothesis, best.pose.inliers > 0.5) == (7, True)


def test_around_the_true_pose_is_none_that_fits_as_well(city, points):
    near = around_of(city, points, found_at())
    assert near[0].static_inliers > 0.9
    assert all(each.static_inliers < near[0].static_inliers for each in near[1:])


@pytest.mark.parametrize("most_poses", [1, 2, 5])
def test_poses_around_stand_apart_and_are_no_more_than_wanted(city, points, most_poses):
    near = around_of(city, points, found_at(along=0.8), most_poses=most_poses, apart_m=0.02)
    assert 1 < len(near) <= 1 + most_poses
    at = [np.r_[each.pose.camera_m, 3 * np.arctan2(*each.pose.R_map_level[1::-1, 0])] for each in near]
    distances = np.linalg.norm(np.array(at)[:, None] - np.array(at), axis=2)
    assert distances[~np.eye(len(at), dtype=bool)].min() >= 0.02
    shares = [each.static_inliers for each in near[1:]]
    assert shares == sorted(shares, reverse=True)


def test_movable_points_do_not_decide_which_pose_is_kept(city, points):
    """Half of the points are wrong and marked as movable. The share of the others is 1."""
    wrong = replace(
        points,
        xyz=np.where(np.arange(len(points))[:, None] % 2, points.xyz, 0.6 * points.xyz).astype(np.float32),
        weight=np.where(np.arange(len(points)) % 2, 1.0, 0.1).astype(np.float32),
    )
    near = around_of(city, wrong, found_at(along=1.4))
    best = max(near[1:], key=lambda each: each.static_inliers)
    assert best.static_inliers > 0.9
    assert np.linalg.norm(best.pose.camera_m - TRUE_M) < 0.1


def test_the_input_stays_unchanged(city, points):
    start = found_at(along=1.0)
    copies = start.camera_m.copy(), start.R_map_level.copy(), points.weight.copy()
    around_of(city, points, start)
    for before, after in zip(copies, (start.camera_m, start.R_map_level, points.weight), strict=True):
        np.testing.assert_array_equal(before, after)
