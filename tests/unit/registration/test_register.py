from dataclasses import replace

import numpy as np
import pytest

from service.geometry.rigid import rotation_y, rotation_z
from service.registration.kernel import QueryPoints, SolverOptions
from service.registration.register import RegistrationSettings, Start, register

HEIGHT_M = 1.5


def start(R, camera_m, hypothesis, *, turned_deg=0.0, moved_m=(0.0, 0.0, 0.0)):
    return Start(rotation_z(np.deg2rad(turned_deg)) @ R, camera_m + np.array(moved_m), hypothesis)


@pytest.fixture(scope="session")
def surveyed(street):
    return street.survey()


def measured(points, *, seed=2):
    """With noise along the ray as ``sigma`` says."""
    noise = np.random.default_rng(seed).normal(0, points.sigma).astype(np.float32)
    return replace(points, xyz=points.xyz + noise[:, None] * points.ray)


def test_a_query_is_registered_within_centimetres_on_a_surveyed_street(surveyed, seen, pose):
    starts = [start(*pose, 0, turned_deg=4, moved_m=(1.0, -0.6, 0.1))]
    best = register(surveyed, measured(seen), starts, HEIGHT_M, RegistrationSettings())[0]
    np.testing.assert_allclose(best.camera_m, pose[1], atol=0.03)
    assert np.rad2deg(np.linalg.norm(best.R_map_level - pose[0])) < 0.2
    assert best.inliers > 0.9
    assert best.scale == pytest.approx(1, abs=2e-3)


def test_the_depths_scale_is_estimated(surveyed, seen, pose):
    short = replace(seen, xyz=seen.xyz / np.float32(1.01))
    best = register(surveyed, short, [start(*pose, 0)], HEIGHT_M, RegistrationSettings())[0]
    assert best.scale == pytest.approx(1.01, abs=2e-3)


def test_positions_are_the_maps_wherever_the_surfels_origin_lies(street, surveyed, seen, pose):
    moved = street.survey(origin=(3.0, -2.1, 0.6))
    one, other = (
        register(cloud, seen, [start(*pose, 0, turned_deg=2)], HEIGHT_M, RegistrationSettings())[0]
        for cloud in (surveyed, moved)
    )
    np.testing.assert_allclose(other.camera_m, one.camera_m, atol=0.01)
    np.testing.assert_allclose(other.camera_m, pose[1], atol=0.03)


def test_the_best_supported_start_comes_first_and_says_whose_it_was(surveyed, seen, pose):
    starts = [
        start(*pose, 5, turned_deg=180),
        start(*pose, 2, moved_m=(9.0, 2.0, 0.0)),
        start(*pose, 7, turned_deg=3, moved_m=(0.5, 0.5, 0.0)),
    ]
    found = register(surveyed, seen, starts, HEIGHT_M, RegistrationSettings())
    assert found[0].hypothesis == 7
    np.testing.assert_allclose(found[0].camera_m, pose[1], atol=0.03)
    inliers = [each.inliers for each in found]
    assert inliers == sorted(inliers, reverse=True)
    assert inliers[0] > inliers[-1] + 0.1


@pytest.fixture(scope="module")
def two_streets(scene_of, streets_at):
    """The street twice, 40 m apart."""
    return scene_of(*streets_at(-6.0, 0.0), *streets_at(-6.0, 40.0)).survey()


def test_every_candidate_keeps_the_number_of_its_hypothesis(two_streets, seen, pose):
    here, there = start(*pose, 6, moved_m=(0.5, 0.3, 0.0)), start(*pose, 3, moved_m=(0.4, 40.3, 0.0))
    for starts in ([here, there], [there, here]):
        found = register(two_streets, seen, starts, HEIGHT_M, RegistrationSettings())
        assert {each.hypothesis for each in found} == {6, 3}
        for each in found:
            assert abs(each.camera_m[1] - (40.0 if each.hypothesis == 3 else 0.0)) < 5


def test_the_starts_that_are_refined_stand_apart_and_are_few(surveyed, seen, pose):
    """Without fine iterations the candidates lie where they were picked, and a single coarse one leaves them spread."""
    still = SolverOptions(iterations=0, reach=1.2, robust_first=1.0, robust_last=1.0)
    few = SolverOptions(iterations=1, reach=2.7, robust_first=2.0, robust_last=0.5, surface=0.2)
    starts = [start(*pose, k, moved_m=(0.9 * k, 0.2 * k, 0.0)) for k in range(6)]
    for refined, apart_m in ((3, 0.5), (4, 1.0), (1, 0.5)):
        settings = RegistrationSettings(fine=still, coarse=few, refined=refined, apart_m=apart_m)
        found = register(surveyed, seen, starts, HEIGHT_M, settings)
        assert len(found) == refined
        for i, one in enumerate(found):
            for other in found[:i]:
                assert np.linalg.norm(one.camera_m - other.camera_m) >= apart_m


def test_starts_are_offset_along_and_across_their_heading(surveyed, seen, pose):
    """Nothing moves: the candidates are the offset starts themselves."""
    still = SolverOptions(iterations=0, reach=1.2, robust_first=1.0, robust_last=1.0)
    offsets = ((0.0, 0.0), (2.0, 0.0), (0.0, 1.0))
    settings = RegistrationSettings(coarse=still, fine=still, offsets_m=offsets)
    left = Start(rotation_z(np.pi / 2), pose[1], 0)
    found = register(surveyed, seen, [left], HEIGHT_M, settings)
    moved = sorted((np.round(each.camera_m - pose[1], 6) + 0.0).tolist() for each in found)
    assert moved == [[-1, 0, 0], [0, 0, 0], [0, 2, 0]]


def test_points_of_the_ground_support_no_candidate(surveyed, seen, pose):
    ground = seen.subset(np.flatnonzero(seen.xyz[:, 2] < 0.25 - HEIGHT_M))
    assert len(ground) > 100
    found = register(surveyed, ground, [start(*pose, 0)], HEIGHT_M, RegistrationSettings())
    assert [each.inliers for each in found] == [0.0] * len(found)


def test_few_points_are_all_used_in_the_coarse_stage(surveyed, seen, pose):
    few = seen.subset(np.arange(0, len(seen), 20))
    assert len(few) < RegistrationSettings().coarse_points
    best = register(surveyed, few, [start(*pose, 0, moved_m=(0.4, 0.4, 0.0))], HEIGHT_M, RegistrationSettings())[0]
    np.testing.assert_allclose(best.camera_m, pose[1], atol=0.05)


def test_a_subset_holds_the_rows_asked_for(seen):
    rows = np.array([5, 2, 9])
    found = seen.subset(rows)
    assert isinstance(found, QueryPoints)
    for name in ("xyz", "ray", "sigma", "weight", "q"):
        np.testing.assert_array_equal(getattr(found, name), getattr(seen, name)[rows])


def test_the_starts_given_are_not_changed(surveyed, seen, pose):
    given = start(*pose, 0, turned_deg=3, moved_m=(0.5, 0.5, 0.0))
    R, camera_m = given.R_map_level.copy(), given.camera_m.copy()
    register(surveyed, seen, [given], HEIGHT_M, RegistrationSettings())
    np.testing.assert_array_equal(given.R_map_level, R)
    np.testing.assert_array_equal(given.camera_m, camera_m)


def test_a_leaning_start_is_set_upright_on_its_walls(surveyed, seen, pose):
    leaning = Start(pose[0] @ rotation_y(np.deg2rad(2)), pose[1], 0)
    best = register(surveyed, seen, [leaning], HEIGHT_M, RegistrationSettings())[0]
    assert np.rad2deg(np.arccos(best.R_map_level[2, 2])) < 0.2
