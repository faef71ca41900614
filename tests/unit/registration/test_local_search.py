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
def test_a_pose_in_another_hollow_has_the_true_one_among_those_around_it(city, points, off):
    """The solver's own iterations from there, two at most, do not reach it."""
    settings = RegistrationSettings()
    few = replace(settings, fine=replace(settings.fine, iterations=2))
    start = found_at(**off)
    near = search_locally(city, points, start, TRUE_M[2], few, AROUND)
    assert near[0].pose is start
    assert away(near)[0] > 0.8
    best = max(near, key=lambda each: each.still)
    assert np.linalg.norm(best.pose.camera_m - TRUE_M) < 0.25
    assert best.still > near[0].still + 0.2
    assert (best.pose.hypothesis, best.pose.inliers > 0.5) == (7, True)


def test_around_the_true_pose_is_none_that_fits_as_well(city, points):
    near = around_of(city, points, found_at())
    assert near[0].still > 0.9
    assert all(each.still < near[0].still for each in near[1:])


@pytest.mark.parametrize("kept", [1, 2, 5])
def test_poses_around_stand_apart_and_are_no_more_than_wanted(city, points, kept):
    near = around_of(city, points, found_at(along=0.8), kept=kept, apart_m=0.02)
    assert 1 < len(near) <= 1 + kept
    at = [np.r_[each.pose.camera_m, 3 * np.arctan2(*each.pose.R_map_level[1::-1, 0])] for each in near]
    distances = np.linalg.norm(np.array(at)[:, None] - np.array(at), axis=2)
    assert distances[~np.eye(len(at), dtype=bool)].min() >= 0.02
    shares = [each.still for each in near[1:]]
    assert shares == sorted(shares, reverse=True)


def test_what_may_have_moved_does_not_say_which_pose_is_kept(city, points):
    """Half of the points are wrong, and known to be able to move: the others' share is whole."""
    wrong = replace(
        points, xyz=np.where(np.arange(len(points))[:, None] % 2, points.xyz, 0.6 * points.xyz).astype(np.float32),
        weight=np.where(np.arange(len(points)) % 2, 1.0, 0.1).astype(np.float32),
    )  # fmt: skip
    near = around_of(city, wrong, found_at(along=1.4))
    best = max(near[1:], key=lambda each: each.still)
    assert best.still > 0.9
    assert np.linalg.norm(best.pose.camera_m - TRUE_M) < 0.1


def test_what_was_found_and_seen_stays_as_it_is(city, points):
    start = found_at(along=1.0)
    kept = start.camera_m.copy(), start.R_map_level.copy(), points.weight.copy()
    around_of(city, points, start)
    for before, after in zip(kept, (start.camera_m, start.R_map_level, points.weight), strict=True):
        np.testing.assert_array_equal(before, after)
