from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.geometry.rigid import rotation_x, rotation_y, rotation_z
from service.registration.kernel import STATE, Piece, QueryPoints, SolverOptions, align, packed_map

#: A fixture of two values: grid and surfels, or rotation and position.
Pair = tuple[Any, Any]


def turned(R, *, roll_deg=0.0, pitch_deg=0.0, yaw_deg=0.0):
    return rotation_z(np.deg2rad(yaw_deg)) @ R @ rotation_y(np.deg2rad(pitch_deg)) @ rotation_x(np.deg2rad(roll_deg))


def angle_deg(R, other):
    return np.rad2deg(np.linalg.norm(R - other) / np.sqrt(2))  # small angles


def scored(cloud, points, states, **options):
    """Return the share of inliers of starts without solver iterations."""
    states = states.copy()
    still = SolverOptions(iterations=0, reach=1.2, robust_first=1.0, robust_last=1.0)
    align(cloud.pieces, points, states, still, **options)
    return states


def joined(one, other):
    names = ("xyz", "ray", "sigma", "weight", "q")
    return QueryPoints(*(np.concatenate([getattr(one, name), getattr(other, name)]) for name in names))


metre = st.floats(-0.7, 0.7)


@given(metre, metre, st.floats(-0.3, 0.3), st.floats(-5, 5), st.floats(-2, 2), st.floats(-2, 2))
@settings(max_examples=25)
def test_from_a_metre_and_five_degrees_away_the_true_pose_comes_back(
    street_map, seen, pose, start_at, settle, x, y, z, yaw, pitch, roll
):
    R, t = pose
    start = start_at(turned(R, yaw_deg=yaw, pitch_deg=pitch, roll_deg=roll), t + [x, y, z])
    found = settle(street_map, seen, start)[0]
    np.testing.assert_allclose(found["t"], t, atol=0.02)
    assert angle_deg(found["R"], R) < 0.1
    assert found["inliers"] > 0.98


@pytest.mark.parametrize(("away_m", "most", "converged"), [(0.3, 1, False), (0.0, 20, True)])
def test_the_state_contains_how_the_solver_ended(street_map, seen, pose, start_at, away_m, most, converged):
    """After one step of a decimetre the solver has not converged. At the true pose it stops long before its last iteration."""
    states = start_at(pose[0], pose[1] + [away_m, 0.0, 0.0])
    options = SolverOptions(iterations=most, reach=1.2, robust_first=0.06, robust_last=0.06)
    align(street_map.pieces, seen, states, options)
    assert bool(states["converged"][0]) == converged
    assert (4 < states["iterations"][0] < most) if converged else states["iterations"][0] == 1


def test_the_error_is_half_the_weighted_squared_distance(street_map, points_at, start_at):
    """One point is 0.1 m in front of a wall that faces it, with noise 0.05 m. The robust kernel is too wide to have an effect."""
    points = points_at([[0.0, 5.9, 0.0]], sigma=0.05)
    states = start_at(np.eye(3), np.array([0.0, 0.0, 1.5]))
    options = SolverOptions(iterations=1, reach=1.2, robust_first=1e6, robust_last=1e6, surface=0.0, prior_weight=1e9)
    align(street_map.pieces, points, states, options)
    thickness_m, ratio = 0.01, 6.0 / 5.9  # the variance is taken where the ray meets the facade
    expected = 0.5 * 0.1**2 / (0.05**2 * ratio**3 + thickness_m**2)
    assert states["error"][0] == pytest.approx(expected, rel=1e-3)


def test_a_turned_frame_stays_a_rotation(street_map, seen, pose, start_at, settle):
    found = settle(street_map, seen, start_at(turned(pose[0], yaw_deg=5), pose[1] + 0.4))[0]["R"]
    np.testing.assert_allclose(found @ found.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(found) == pytest.approx(1)


@pytest.mark.parametrize("scale", [0.99, 1.01])
def test_a_depth_that_is_a_hundredth_too_long_or_short_is_recovered(street_map, seen, pose, start_at, settle, scale):
    wrong = replace(seen, xyz=seen.xyz / np.float32(scale))
    found = settle(street_map, wrong, start_at(pose[0], pose[1] + [0.3, -0.2, 0]))[0]
    assert np.exp(found["log_scale"]) == pytest.approx(scale, abs=1e-3)
    np.testing.assert_allclose(found["t"], pose[1], atol=0.02)


def test_a_disparity_offset_is_recovered(street_map, seen, pose, start_at, settle):
    """A point at true depth z with 0.3 px too little disparity appears at z / (1 - 0.3 z / (f b))."""
    stretch = 1 / (1 - 0.3 * seen.q)
    wrong = replace(seen, xyz=seen.xyz * stretch[:, None], q=seen.q * stretch)
    found = settle(street_map, wrong, start_at(*pose), free_scale=False, free_offset=True)[0]
    assert found["offset"] == pytest.approx(0.3, abs=0.01)
    np.testing.assert_allclose(found["t"], pose[1], atol=0.02)


def test_fixed_unknowns_stay(street_map, seen, pose, start_at, settle):
    wrong = replace(seen, xyz=seen.xyz * np.float32(1.01))
    start = start_at(*pose, log_scale=0.002, offset=0.1)
    found = settle(street_map, wrong, start, free_scale=False, free_offset=False)[0]
    assert (found["log_scale"], found["offset"]) == (0.002, 0.1)


def test_without_iterations_nothing_moves_and_the_score_alone_is_written(street_map, seen, pose, start_at):
    start = start_at(turned(pose[0], yaw_deg=3), pose[1] + 0.2, log_scale=0.01, offset=0.1)
    found = scored(street_map, seen, start)
    for name in set(STATE.names or ()) - {"inliers", "weight"}:
        np.testing.assert_array_equal(found[name], start[name])
    assert 0 < found["inliers"][0] < 1


def test_without_a_tolerance_all_but_the_score_is_the_same(street_map, seen, pose, start_at):
    options = SolverOptions(iterations=5, reach=1.0, robust_first=0.5, robust_last=0.1)
    both = [start_at(turned(pose[0], yaw_deg=2), pose[1] + 0.1) for _ in range(2)]
    for states, tolerance_m in zip(both, (0.1, 0.0), strict=True):
        align(street_map.pieces, seen, states, options, tolerance_m=tolerance_m)
    for name in set(STATE.names or ()) - {"inliers", "weight"}:
        np.testing.assert_array_equal(both[0][name], both[1][name])
    assert both[0]["inliers"][0] > 0.5
    assert both[1]["inliers"][0] == both[1]["weight"][0] == 0


def test_exact_points_score_one_at_their_pose(street_map, seen, pose, start_at):
    # Where two rectangles meet, the nearest surfel may be the other's.
    assert scored(street_map, seen, start_at(*pose))["inliers"][0] > 0.98


def test_the_score_falls_the_further_the_points_are_moved(street_map, seen, pose, start_at):
    moved = [scored(street_map, seen, start_at(pose[0], pose[1] + [d, d, d]))["inliers"][0] for d in (0, 0.1, 0.2, 0.4)]
    assert moved == sorted(moved, reverse=True)
    assert moved[0] - moved[3] > 0.4


@pytest.fixture
def plain(scene_of):
    """Return surfels and grid of a ground of 12 x 12 m about the origin, as ``align`` takes them."""
    surfels = scene_of(((-6, -6, 0), (12, 0, 0), (0, 12, 0))).surfels()
    return packed_map(surfels, cell_m=0.4, reach_m=1.2)[:2]


STILL = SolverOptions(iterations=0, reach=1.2, robust_first=1.0, robust_last=1.0)
ON_GROUND = [[1.0, 1, -1.5], [2, -2, -1.5], [-3, 1, -1.5], [0, 2, -1.5]]


def share(plain: Pair, points, states, **options):
    align((Piece(*plain),), points, states, STILL, **options)
    return float(states["inliers"][0])


@pytest.mark.parametrize(("above_m", "expected"), [(0.0, 1.0), (0.1, np.exp(-0.5)), (-0.2, np.exp(-2.0))])
def test_a_point_off_the_surface_counts_by_the_tolerance(plain, points_at, start_at, above_m, expected):
    points = points_at(ON_GROUND, sigma=0.0)
    found = share(plain, points, start_at(np.eye(3), [0, 0, 1.5 + above_m]), tolerance_m=0.1)
    assert found == pytest.approx(expected, abs=1e-5)


def test_the_uncertainty_along_the_ray_widens_the_tolerance(plain, points_at, start_at):
    """The ray is along the normal. With sigma 0.4 and tolerance 0.3, 0.3 m are 0.6 standard deviations."""
    points = points_at([[0, 0, -1.5]], sigma=0.4)
    found = share(plain, points, start_at(np.eye(3), [0, 0, 1.8]), tolerance_m=0.3)
    assert found == pytest.approx(np.exp(-0.5 * 0.36), abs=1e-5)


def test_only_the_component_of_the_uncertainty_along_the_normal_counts(plain, points_at, start_at):
    """A 3-4-5 ray hits the ground at cosine 0.6. Sigma 0.5 is 0.3 across the ground, and with tolerance 0.4 it is 0.5."""
    points = points_at([[2, 0, -1.5]], sigma=0.5)
    found = share(plain, points, start_at(np.eye(3), [0, 0, 2.0]), tolerance_m=0.4)
    assert found == pytest.approx(np.exp(-0.5), abs=1e-5)


@pytest.mark.parametrize(("sigma", "expected"), [(0.0, 0.0), (0.5, 1.0)])
def test_a_point_beyond_the_edge_of_its_surface_counts_if_that_is_within_its_uncertainty(
    plain, points_at, start_at, sigma, expected
):
    """The point is 1.1 m beyond the last surfel. The limit is 1 m, and sqrt(2) m with sigma 0.5."""
    points = points_at([[6.95, 0.15, -1.5]], sigma=sigma)
    assert share(plain, points, start_at(np.eye(3), [0, 0, 1.5])) == pytest.approx(expected, abs=1e-5)


def test_a_point_off_the_map_is_no_inlier(plain, points_at, start_at):
    points = points_at([*ON_GROUND, [1, 1, 4], [500, 0, 0], [-500, 0, 0], [0, 0, -500]], sigma=0.0)
    assert share(plain, points, start_at(np.eye(3), [0, 0, 1.5])) == pytest.approx(0.5, abs=1e-6)


def test_points_below_the_limit_do_not_count_in_the_score(plain, points_at, start_at):
    points = points_at([*ON_GROUND, [1, 1, 4]], sigma=0.0)
    start = start_at(np.eye(3), [0, 0, 1.5])
    assert share(plain, points, start, height_min_m=-1.2) == 0
    assert start["weight"][0] == 1


def test_a_score_weighs_points_by_their_weight_and_their_certainty(plain, points_at, start_at):
    """Four points of weight 3 are on the ground. One of weight 1 and sigma 0.5 is above it and counts half."""
    points = points_at([*ON_GROUND, [1, 1, 4]], weight=[3, 3, 3, 3, 1])
    points = replace(points, sigma=np.array([0, 0, 0, 0, 0.5], np.float32))
    start = start_at(np.eye(3), [0, 0, 1.5])
    assert share(plain, points, start) == pytest.approx(12 / 12.5, abs=1e-6)
    assert start["weight"][0] == pytest.approx(12.5)


def test_points_of_weight_zero_do_not_matter(street_map, seen, pose, start_at, settle, points_at):
    junk = points_at(np.random.default_rng(5).uniform([2, -5, -1.5], [20, 5, 3], (400, 3)), weight=0.0)
    start = start_at(turned(pose[0], yaw_deg=3), pose[1] + [0.3, 0.3, 0.1])
    alone, among = (settle(street_map, each, start, prior_weight=0.0)[0] for each in (seen, joined(seen, junk)))
    np.testing.assert_allclose(among["t"], alone["t"], atol=1e-4)
    np.testing.assert_allclose(among["R"], alone["R"], atol=1e-5)
    assert among["inliers"] == pytest.approx(alone["inliers"], abs=1e-4)
    assert among["matched"] == alone["matched"]
    heavy = replace(junk, weight=np.full_like(junk.weight, 3))
    assert settle(street_map, joined(seen, heavy), start)[0]["inliers"] < alone["inliers"] - 0.2


def test_a_car_that_has_moved_by_half_a_metre_hardly_moves_the_pose(street_map, seen, pose, start_at, settle):
    x, y, _ = (seen.xyz @ pose[0].T.astype(np.float32) + pose[1]).T
    lorry = (x > 7.9) & (x < 13.1) & (y > 2.9) & (y < 5.1)
    assert 0.03 < lorry.mean() < 0.3
    moved = replace(seen, xyz=seen.xyz - 0.5 * np.outer(lorry, pose[0].T[:, 0]).astype(np.float32))
    found = settle(street_map, moved, start_at(*pose))[0]
    np.testing.assert_allclose(found["t"], pose[1], atol=0.03)


def test_matched_is_the_weight_of_points_with_a_surfel(plain: Pair, points_at, start_at):
    points = points_at([*ON_GROUND, [1, 1, 4], [500, 0, 0]], weight=[1, 2, 3, 4, 50, 60])
    start = start_at(np.eye(3), [0, 0, 1.5])
    align((Piece(*plain),), points, start, SolverOptions(iterations=1, reach=1.2, robust_first=1.0, robust_last=1.0))
    assert start["matched"][0] == 10


def test_a_point_further_than_reach_from_its_surfel_is_left_out(plain: Pair, points_at, start_at):
    """The grid reaches 1.2 m, but the solver option is 0.5 m."""
    points = points_at(ON_GROUND)
    near, far = start_at(np.eye(3), [0, 0, 1.9]), start_at(np.eye(3), [0, 0, 2.1])
    for start in (near, far):
        align(
            (Piece(*plain),), points, start, SolverOptions(iterations=1, reach=0.5, robust_first=1.0, robust_last=1.0)
        )
    assert near["matched"][0] == 4
    assert far["matched"][0] == 0


def test_several_starts_at_once_give_the_same_as_one_by_one(street_map, seen, pose, start_at, settle):
    rng = np.random.default_rng(6)
    starts = np.concatenate(
        [start_at(turned(pose[0], yaw_deg=rng.uniform(-5, 5)), pose[1] + rng.uniform(-0.5, 0.5, 3)) for _ in range(5)]
    )
    together = settle(street_map, seen, starts)
    one_by_one = np.concatenate([settle(street_map, seen, starts[k : k + 1]) for k in range(5)])
    assert together.tobytes() == one_by_one.tobytes()
    assert len({each["t"].tobytes() for each in together}) == 5


def test_threads_do_not_disturb_each_other(street_map, seen, pose, start_at, settle):
    starts = [start_at(turned(pose[0], yaw_deg=k), pose[1] + [0.1 * k, 0, 0]) for k in range(-4, 4)]
    expected = [settle(street_map, seen, each).tobytes() for each in starts]
    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(lambda each: settle(street_map, seen, each).tobytes(), starts))
    assert found == expected


def test_no_points_move_nothing_and_score_zero(plain: Pair, points_at, start_at):
    start = start_at(rotation_y(0.1), [1, 2, 3], anchor=[0, 0, 0])
    found = start.copy()
    align((Piece(*plain),), points_at(np.zeros((0, 3))), found, SolverOptions(iterations=5, **PRIORS))
    np.testing.assert_array_equal(found["t"], start["t"])
    np.testing.assert_array_equal(found["R"], start["R"])
    assert found["inliers"][0] == 0


LOST = [[300.0, 0, 0]] * 10  # meets no surfel: the priors alone move the start
PRIORS: dict[str, Any] = {"reach": 1.0, "robust_first": 1.0, "robust_last": 1.0, "free_offset": True}


def test_the_priors_alone_lead_to_the_anchor_without_scale_or_offset(plain: Pair, points_at, start_at):
    start = start_at(rotation_z(0.4), [3, -4, 2], log_scale=0.01, offset=0.2, anchor=[1, 2, 1.5])
    align((Piece(*plain),), points_at(LOST), start, SolverOptions(iterations=1, **PRIORS))
    np.testing.assert_allclose(start["t"][0], [1, 2, 1.5], atol=1e-9)
    np.testing.assert_allclose(start["R"][0], rotation_z(0.4), atol=1e-12)
    assert (start["log_scale"][0], start["offset"][0]) == pytest.approx((0, 0), abs=1e-12)


@pytest.mark.parametrize("up", [[0.0, 0.0, 1.0], [0.1, -0.05, 0.99]])
@pytest.mark.parametrize(("roll_deg", "pitch_deg"), [(4, 0), (0, 4), (-3, 2)])
def test_the_priors_alone_stand_the_query_upright_on_the_ground(
    plain: Pair, points_at, start_at, roll_deg, pitch_deg, up
):
    up = np.array(up) / np.linalg.norm(up)
    leaning = turned(rotation_z(0.7), roll_deg=roll_deg, pitch_deg=pitch_deg)
    start = start_at(leaning, [0, 0, 1.5], up=up)
    align((Piece(*plain),), points_at(LOST), start, SolverOptions(iterations=30, **PRIORS))
    np.testing.assert_allclose(start["R"][0][:, 2], up, atol=1e-6)
    assert np.arctan2(start["R"][0][1, 0], start["R"][0][0, 0]) == pytest.approx(0.7, abs=0.01)


def test_a_step_turns_by_a_tenth_of_a_radian_at_most(plain: Pair, points_at, start_at):
    start = start_at(rotation_y(0.5), [0, 0, 1.5])
    align((Piece(*plain),), points_at(LOST), start, SolverOptions(iterations=1, **PRIORS))
    np.testing.assert_allclose(start["R"][0], rotation_y(0.4), atol=1e-9)


def test_points_outweigh_the_height_prior(plain: Pair, points_at, start_at):
    """The anchor is at 1.7 m, and all points imply 1.5 m. Each point has sigma 3 cm, the prior 15 cm with a weight of 1/20."""
    rng = np.random.default_rng(7)
    points = points_at(np.c_[rng.uniform(-4, 4, (200, 2)), np.full(200, -1.5)], sigma=0.0)
    start = start_at(np.eye(3), [0, 0, 1.7])
    align(
        (Piece(*plain),),
        points,
        start,
        SolverOptions(iterations=30, reach=1.2, robust_first=1.0, robust_last=1.0, free_scale=False),
    )
    assert start["t"][0, 2] == pytest.approx(1.5, abs=0.005)
    assert start["t"][0, 2] > 1.5
