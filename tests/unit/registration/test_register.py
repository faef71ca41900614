from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from model_training.mapping.voxel_map import lattice_origin
from service.geometry.rigid import rotation_y, rotation_z, transform_from
from service.registration.kernel import QueryPoints, SolverOptions, align
from service.registration.register import Registered, RegistrationSettings, Start, register
from tests.unit.street_scene import Scene

#: A fixture of two values: grid and surfels, or rotation and position.
Pair = tuple[Any, Any]

HEIGHT_M = 1.5
STILL = SolverOptions(iterations=0, reach=1.2, robust_first=1.0, robust_last=1.0)
NOTHING_MOVES: dict[str, Any] = {"coarse": STILL, "middle": STILL, "fine": STILL, "turns_rad": ()}


def start(R, camera_m, hypothesis, *, turned_deg=0.0, moved_m=(0.0, 0.0, 0.0)):
    return Start(rotation_z(np.deg2rad(turned_deg)) @ R, camera_m + np.array(moved_m), hypothesis)


@pytest.fixture(scope="session")
def surveyed(street):
    return street.survey()


def measured(points, *, seed=2):
    """Return the points with noise along the ray as ``sigma`` states."""
    noise = np.random.default_rng(seed).normal(0, points.sigma).astype(np.float32)
    return replace(points, xyz=points.xyz + noise[:, None] * points.ray)


def test_a_query_is_registered_within_centimetres_on_a_surveyed_street(surveyed, seen, pose: Pair):
    starts = [start(*pose, 0, turned_deg=4, moved_m=(1.0, -0.6, 0.1))]
    best = register(surveyed, measured(seen), starts, HEIGHT_M, RegistrationSettings())[0]
    np.testing.assert_allclose(best.camera_m, pose[1], atol=0.03)
    assert np.rad2deg(np.linalg.norm(best.R_map_level - pose[0])) < 0.2
    assert best.inliers > 0.9
    assert best.scale == pytest.approx(1, abs=2e-3)


def test_the_depths_scale_is_estimated(surveyed, seen, pose: Pair):
    short = replace(seen, xyz=seen.xyz / np.float32(1.01))
    best = register(surveyed, short, [start(*pose, 0)], HEIGHT_M, RegistrationSettings())[0]
    assert best.scale == pytest.approx(1.01, abs=2e-3)


def test_positions_are_the_maps_wherever_the_surfels_origin_lies(street, surveyed, seen, pose: Pair):
    moved = street.survey(origin=(3.0, -2.1, 0.6))
    one, other = (
        register(cloud, seen, [start(*pose, 0, turned_deg=2)], HEIGHT_M, RegistrationSettings())[0]
        for cloud in (surveyed, moved)
    )
    np.testing.assert_allclose(other.camera_m, one.camera_m, atol=0.01)
    np.testing.assert_allclose(other.camera_m, pose[1], atol=0.03)


AWAY_M = np.array([48_000.0, -36_000.0, 300.0])


@pytest.mark.parametrize(
    ("origin_m", "atol_m"),
    [
        pytest.param(AWAY_M, 1e-5, id="a map 60 km from the zero of its frame"),
        pytest.param(0.5 * AWAY_M, 2e-3, id="a town 60 km from another one, with the origin between them"),
        pytest.param(np.zeros(3), 4e-3, id="the surfels' origin 60 km away"),
    ],
)
def test_far_from_the_origin_a_query_is_registered_as_at_the_origin(
    street, surveyed, seen, pose: Pair, origin_m, atol_m
):
    """A surfel's position has single precision. Its step is 2 mm at 30 km from the surfels' origin, and 4 mm at 60 km."""
    R, camera_m = pose
    far = Scene(*zip(street.corners + AWAY_M, street.a, street.b, strict=True)).survey(
        origin=lattice_origin(0.3, origin_m)
    )
    started = {"turned_deg": 4, "moved_m": (1.0, -0.6, 0.1)}
    one, other = (
        register(cloud, measured(seen), [start(R, camera_m + away, 0, **started)], HEIGHT_M, RegistrationSettings())[0]
        for cloud, away in ((surveyed, np.zeros(3)), (far, AWAY_M))
    )
    np.testing.assert_allclose(other.camera_m - AWAY_M, one.camera_m, atol=atol_m)
    np.testing.assert_allclose(other.R_map_level, one.R_map_level, atol=atol_m / 10)
    assert other.inliers == pytest.approx(one.inliers, abs=0.01)


def test_the_best_supported_start_comes_first_and_says_whose_it_was(surveyed, seen, pose: Pair):
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
    """Return the street twice, 40 m apart."""
    return scene_of(*streets_at(-6.0, 0.0), *streets_at(-6.0, 40.0)).survey()


def test_every_candidate_keeps_the_number_of_its_hypothesis(two_streets, seen, pose: Pair):
    here, there = start(*pose, 6, moved_m=(0.5, 0.3, 0.0)), start(*pose, 3, moved_m=(0.4, 40.3, 0.0))
    for starts in ([here, there], [there, here]):
        found = register(two_streets, seen, starts, HEIGHT_M, RegistrationSettings())
        assert {each.hypothesis for each in found} == {6, 3}
        for each in found:
            assert abs(each.camera_m[1] - (40.0 if each.hypothesis == 3 else 0.0)) < 5


def test_the_starts_that_are_refined_stand_apart_and_are_few(surveyed, seen, pose: Pair):
    """Without further iterations the candidates stay where they were chosen. One coarse iteration leaves them spread."""
    few = SolverOptions(iterations=1, reach=1.2, robust_first=0.8, robust_last=0.3, surface=0.1)
    starts = [start(*pose, k, moved_m=(0.9 * k, 0.2 * k, 0.0)) for k in range(6)]
    for refined, apart_m in ((3, 0.5), (4, 1.0), (1, 0.5)):
        settings = RegistrationSettings(fine=STILL, middle=STILL, coarse=few, refined=refined, apart_m=apart_m)
        found = register(surveyed, seen, starts, HEIGHT_M, settings)
        assert len(found) == refined
        for i, one in enumerate(found):
            for other in found[:i]:
                assert np.linalg.norm(one.camera_m - other.camera_m) >= apart_m


def test_starts_are_offset_along_and_across_their_heading(surveyed, seen, pose):
    """Without iterations, the candidates are the offset starts themselves."""
    offsets = ((0.0, 0.0), (2.0, 0.0), (0.0, 1.0))
    settings = RegistrationSettings(**NOTHING_MOVES, offsets_m=offsets, kept_of_each=(3, 3))
    left = Start(rotation_z(np.pi / 2), pose[1], 0)
    found = register(surveyed, seen, [left], HEIGHT_M, settings)
    moved = sorted((np.round(each.camera_m - pose[1], 6) + 0.0).tolist() for each in found)
    assert moved == [[-1, 0, 0], [0, 0, 0], [0, 2, 0]]


@pytest.mark.parametrize(("most_starts", "turns_deg"), [(6, [0, 10, -10]), (5, [0])])
def test_starts_are_turned_too_where_they_do_not_become_too_many(surveyed, seen, pose, most_starts, turns_deg):
    """Two offsets and three yaws make six. The yaw is about the z axis of the level frame, also on a slope."""
    settings = RegistrationSettings(
        **NOTHING_MOVES | {"turns_rad": tuple(np.deg2rad([10, -10]))},
        most_starts=most_starts,
        offsets_m=((0.0, 0.0), (2.0, 0.0)),
        kept_of_each=(9, 9),
        refined=9,
        apart_m=0.0,
    )
    leaning = Start(pose[0] @ rotation_y(0.2), pose[1], 0)
    found = register(surveyed, seen, [leaning], HEIGHT_M, settings)
    turned = [leaning.R_map_level.T @ each.R_map_level for each in found]
    assert len(found) == 2 * len(turns_deg)
    assert sorted(round(np.rad2deg(np.arctan2(R[1, 0], R[0, 0]))) for R in turned) == sorted(2 * turns_deg)
    np.testing.assert_allclose([R[2, 2] for R in turned], 1)
    for each in found:  # offset along the start's heading, whichever way it was turned afterwards
        away = leaning.R_map_level.T @ (each.camera_m - pose[1])
        assert min(np.linalg.norm(away), np.linalg.norm(away - [2, 0, 0])) < 1e-9


@pytest.mark.parametrize(
    ("options", "kept"),
    [
        ({"kept": 4, "kept_of_each": (1, 5)}, 2),
        ({"kept": 5, "kept_of_each": (1, 5)}, 2),
        ({"kept": 6, "kept_of_each": (1, 5)}, 3),
        ({"kept": 2, "kept_of_each": (2, 5)}, 2),
        ({"kept": 40, "kept_of_each": (1, 4)}, 4),
    ],
)
def test_so_many_starts_of_each_hypothesis_go_on_however_badly_another_fares(
    two_streets, seen, pose: Pair, options, kept
):
    """Without iterations. Hypothesis 4 is in the street, 9 in a field without map surfaces."""
    starts = [start(*pose, 4), start(*pose, 9, moved_m=(500.0, 0.0, 0.0))]
    settings = RegistrationSettings(**NOTHING_MOVES, **options, refined=20)
    found = register(two_streets, seen, starts, HEIGHT_M, settings)
    assert sorted(each.hypothesis for each in found) == [4] * kept + [9] * kept
    assert found[0].hypothesis == 4
    np.testing.assert_allclose(found[0].camera_m, pose[1], atol=1e-9)  # the one start that is not offset
    assert {each.inliers for each in found if each.hypothesis == 9} == {0.0}


def test_the_starts_of_one_hypothesis_that_go_on_stand_apart(surveyed, seen, pose: Pair):
    offsets = ((0.0, 0.0), (0.3, 0.0), (0.0, 0.3), (2.0, 0.0))
    settings = RegistrationSettings(**NOTHING_MOVES, offsets_m=offsets, kept_of_each=(3, 3), apart_m=0.5)
    found = register(surveyed, seen, [start(*pose, 0)], HEIGHT_M, settings)
    away = sorted(round(float(np.linalg.norm(each.camera_m - pose[1])), 6) for each in found)
    assert away == [0, 2]


def test_converging_hypotheses_are_refined_once(surveyed, seen, pose: Pair):
    """Two starts a metre apart converge to the true pose. Only one of them goes on to the last stage."""
    starts = [start(*pose, 0, moved_m=(0.5, 0.0, 0.0)), start(*pose, 1, moved_m=(-0.5, 0.0, 0.0))]
    settings = RegistrationSettings(offsets_m=((0.0, 0.0),), refined=4)
    found = register(surveyed, seen, starts, HEIGHT_M, settings)
    assert len(found) == 1
    np.testing.assert_allclose(found[0].camera_m, pose[1], atol=0.03)


@pytest.mark.parametrize(("true", "beside"), [(0, 1), (1, 0), (7, 3)])
@pytest.mark.parametrize(("weight", "true_goes_on"), [(0.0, True), (0.5, True), (2.0, False)])
def test_the_similarity_that_a_start_had_helps_to_choose_which_go_to_the_end(
    two_streets, seen, pose: Pair, weight, true_goes_on, true, beside
):
    """Without iterations. One start is at the true pose. The other, 2.5 m beside, fits worse and has 0.5 more similarity."""
    starts = [
        replace(start(*pose, true), similarity=0.4),
        replace(start(*pose, beside, moved_m=(0.0, 2.5, 0.0)), similarity=0.9),
    ]
    settings = RegistrationSettings(**NOTHING_MOVES, offsets_m=((0.0, 0.0),), similarity_weight=weight, refined=1)
    found = register(two_streets, seen, sorted(starts, key=lambda each: each.hypothesis), HEIGHT_M, settings)
    assert [each.hypothesis for each in found] == [true if true_goes_on else beside]


def test_the_middle_stage_moves_the_starts_by_its_own_options_and_points(surveyed, seen, pose: Pair, start_at):
    """Only this stage iterates. The candidate is where the solver ends with every n-th point."""
    options = SolverOptions(iterations=4, reach=1.2, robust_first=0.6, robust_last=0.1)
    settings = RegistrationSettings(
        **NOTHING_MOVES | {"middle": options}, offsets_m=((0.0, 0.0),), middle_points=101, coarse_points=7
    )
    moved = start(*pose, 0, moved_m=(0.3, 0.2, 0.0))
    found = register(surveyed, seen, [moved], HEIGHT_M, settings)[0]
    few = seen.subset(np.linspace(0, len(seen) - 1, 101).astype(np.intp))
    state = start_at(moved.R_map_level, moved.camera_m - surveyed.origin_m)
    align(surveyed.pieces, few, state, options)
    np.testing.assert_allclose(found.camera_m - surveyed.origin_m, state["t"][0], atol=1e-12)
    np.testing.assert_allclose(found.R_map_level, state["R"][0], atol=1e-12)
    assert np.linalg.norm(found.camera_m - moved.camera_m) > 0.2


def test_the_fine_stage_lets_no_point_weigh_too_little_but_the_score_is_by_their_own_weights(
    surveyed, seen, pose: Pair, start_at
):
    """Only this stage iterates. Every third point has a weight of 0.1, and 0.7 in the last stage."""
    options = SolverOptions(iterations=5, reach=1.2, robust_first=0.6, robust_last=0.1)
    settings = RegistrationSettings(
        **NOTHING_MOVES | {"fine": options}, offsets_m=((0.0, 0.0),), fine_weight=0.7, tolerance_m=0.12
    )
    trusted = np.where(np.arange(len(seen)) % 3 > 0, 2.0, 0.1).astype(np.float32)
    points, raised = replace(seen, weight=trusted), replace(seen, weight=np.maximum(trusted, np.float32(0.7)))
    moved = start(*pose, 0, moved_m=(0.3, 0.2, 0.0))
    found = register(surveyed, points, [moved], HEIGHT_M, settings)[0]
    state = start_at(moved.R_map_level, moved.camera_m - surveyed.origin_m)
    align(surveyed.pieces, raised, state, options)
    np.testing.assert_allclose(found.camera_m - surveyed.origin_m, state["t"][0], atol=1e-12)
    np.testing.assert_allclose(found.information, state["information"][0], rtol=1e-9)
    align(
        surveyed.pieces,
        points,
        state,
        STILL,
        tolerance_m=0.12,
        height_min_m=settings.ground_m - HEIGHT_M,
    )
    assert found.inliers == pytest.approx(state["inliers"][0], abs=1e-12)
    np.testing.assert_array_equal(points.weight, trusted)


def test_points_of_the_ground_support_no_candidate(surveyed, seen, pose: Pair):
    ground = seen.subset(np.flatnonzero(seen.xyz[:, 2] < 0.25 - HEIGHT_M))
    assert len(ground) > 100
    found = register(surveyed, ground, [start(*pose, 0)], HEIGHT_M, RegistrationSettings())
    assert [each.inliers for each in found] == [0.0] * len(found)


def test_few_points_are_all_used_in_the_coarse_stage(surveyed, seen, pose: Pair):
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


def test_the_starts_given_are_not_changed(surveyed, seen, pose: Pair):
    given = start(*pose, 0, turned_deg=3, moved_m=(0.5, 0.5, 0.0))
    R, camera_m = given.R_map_level.copy(), given.camera_m.copy()
    register(surveyed, seen, [given], HEIGHT_M, RegistrationSettings())
    np.testing.assert_array_equal(given.R_map_level, R)
    np.testing.assert_array_equal(given.camera_m, camera_m)


def test_a_leaning_start_is_set_upright_on_its_walls(surveyed, seen, pose):
    leaning = Start(pose[0] @ rotation_y(np.deg2rad(2)), pose[1], 0)
    best = register(surveyed, seen, [leaning], HEIGHT_M, RegistrationSettings())[0]
    assert np.rad2deg(np.arccos(best.R_map_level[2, 2])) < 0.2


def test_a_pose_of_another_frame_follows_from_that_of_the_reference():
    """The other level frame is 2 m ahead of the reference and rotated by 90 degrees."""
    pose = Registered(
        rotation_z(np.pi / 2), np.array([10.0, 5.0, 1.5]), 1.0, 0.0, 0.5, np.eye(8), 3, converged=True, iterations=8
    )
    other = pose.of_frame(transform_from(rotation_z(np.pi / 2), np.array([2.0, 0.0, 0.1])))
    np.testing.assert_allclose(other.camera_m, [10.0, 7.0, 1.6], atol=1e-12)
    np.testing.assert_allclose(other.R_map_level, rotation_z(np.pi), atol=1e-12)
    np.testing.assert_array_equal(pose.T_map_level, transform_from(pose.R_map_level, pose.camera_m))
    assert (other.hypothesis, other.inliers, other.converged, other.iterations) == (3, 0.5, True, 8)
