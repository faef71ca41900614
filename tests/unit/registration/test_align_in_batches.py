"""The kernel processes 32 points at a time. Results must not depend on the batch boundaries."""

from dataclasses import fields
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.geometry.rigid import rotation_z
from service.registration.kernel import QueryPoints, SolverOptions, align, gradients

AROUND_A_BATCH = [0, 1, 2, 31, 32, 33, 63, 64, 65, 96, 97]
SOLVE = SolverOptions(iterations=8, reach=1.2, robust_first=0.8, robust_last=0.1, free_offset=True)
ONE_STEP = SolverOptions(iterations=1, reach=1.2, robust_first=0.5, robust_last=0.5, free_offset=True)
STILL = SolverOptions(iterations=0, reach=1.2, robust_first=1.0, robust_last=1.0)
SUM: dict[str, Any] = {"rtol": 1e-9, "atol": 1e-6}  # sums of up to 1e6 in another order


def joined(*parts):
    return QueryPoints(*(np.concatenate([getattr(each, f.name) for each in parts]) for f in fields(QueryPoints)))


@pytest.fixture(scope="module")
def mixed(seen):
    """Return points of the street in random order with various weights and sigmas. A tenth lie where the map is empty."""
    rng = np.random.default_rng(4)
    rows = rng.permutation(len(seen))[:400]
    some = seen.subset(rows)
    xyz = np.where(rng.random((400, 1)) < 0.1, some.xyz + np.float32(700), some.xyz)
    sigma, weight = rng.uniform(0.01, 0.3, 400), rng.uniform(0.2, 3.0, 400)
    return QueryPoints(xyz, some.ray, sigma.astype(np.float32), weight.astype(np.float32), some.q)


@pytest.fixture(scope="module")
def solved(street_map, pose, start_at):
    """Return the state after the solver, from a start with a small error. The score counts points above the ground."""

    def solve(points, options):
        state = start_at(rotation_z(0.03) @ pose[0], pose[1] + [0.2, -0.1, 0.05], log_scale=0.002, offset=0.05)
        align(street_map.pieces, points, state, options, tolerance_m=0.15, height_min_m=-1.2)
        return state[0]

    return solve


@pytest.mark.parametrize("before", AROUND_A_BATCH)
@pytest.mark.parametrize("count", [1, 31, 32, 33, 64, 65])
def test_points_that_weigh_nothing_only_move_the_bounds_of_batches(mixed, solved, before, count):
    points, nothing = mixed.subset(np.arange(count)), mixed.subset(np.arange(before))
    nothing = QueryPoints(nothing.xyz, nothing.ray, nothing.sigma, np.zeros(before, np.float32), nothing.q)
    found, expected = solved(joined(nothing, points), SOLVE), solved(points, SOLVE)
    for name in found.dtype.names:
        np.testing.assert_allclose(found[name], expected[name], **SUM, err_msg=name)


@given(first=st.integers(0, 130), second=st.integers(0, 130), seed=st.integers(0, 10**6))
@settings(max_examples=60)
def test_the_result_of_a_set_is_the_sum_of_its_parts(mixed, solved, first, second, seed):
    """Information and matched weight are sums over the parts. The score is their weighted mean."""
    rows = np.random.default_rng(seed).permutation(len(mixed))
    parts = [mixed.subset(rows[:first]), mixed.subset(rows[first : first + second])]
    whole, (one, other) = solved(joined(*parts), ONE_STEP), (solved(part, ONE_STEP) for part in parts)
    np.testing.assert_allclose(whole["information"], one["information"] + other["information"], **SUM)
    assert whole["matched"] == pytest.approx(one["matched"] + other["matched"])
    whole, (one, other) = solved(joined(*parts), STILL), (solved(part, STILL) for part in parts)
    assert whole["weight"] == pytest.approx(one["weight"] + other["weight"])
    together = one["inliers"] * one["weight"] + other["inliers"] * other["weight"]
    assert whole["inliers"] * whole["weight"] == pytest.approx(together)


@pytest.mark.parametrize("count", AROUND_A_BATCH[1:])
def test_the_information_of_points_is_the_sum_of_single_ones(mixed, solved, count):
    alone = [solved(mixed.subset(np.array([k])), ONE_STEP) for k in range(count)]
    whole = solved(mixed.subset(np.arange(count)), ONE_STEP)
    np.testing.assert_allclose(whole["information"], np.sum([each["information"] for each in alone], axis=0), **SUM)
    assert whole["matched"] == pytest.approx(sum(each["matched"] for each in alone))
    alone = [solved(mixed.subset(np.array([k])), STILL) for k in range(count)]
    whole = solved(mixed.subset(np.arange(count)), STILL)
    assert whole["weight"] == pytest.approx(sum(each["weight"] for each in alone))
    assert whole["inliers"] * whole["weight"] == pytest.approx(sum(each["inliers"] * each["weight"] for each in alone))


@pytest.mark.parametrize("count", AROUND_A_BATCH[1:])
def test_the_gradient_of_points_is_the_sum_of_single_gradients(mixed, street_map, pose, start_at, count):
    start = start_at(rotation_z(0.03) @ pose[0], pose[1] + [0.2, -0.1, 0.05], log_scale=0.002, offset=0.05)

    def pulled(rows):
        patch = np.arange(len(rows), dtype=np.int32)
        return gradients(street_map.pieces, mixed.subset(rows), start, ONE_STEP, patch)

    alone = np.concatenate([pulled(np.array([k])) for k in range(count)])
    np.testing.assert_array_equal(pulled(np.arange(count)), alone)
    assert (np.abs(alone).max(axis=1) > 0).any()


@given(seed=st.integers(0, 10**6), count=st.sampled_from(AROUND_A_BATCH[3:]))
@settings(max_examples=25)
def test_the_order_of_the_points_does_not_move_the_pose(mixed, solved, seed, count):
    rows = np.arange(count)
    found, other = (solved(mixed.subset(each), SOLVE) for each in (rows, np.random.default_rng(seed).permutation(rows)))
    np.testing.assert_allclose(other["t"], found["t"], atol=1e-7)
    np.testing.assert_allclose(other["R"], found["R"], atol=1e-8)
    assert other["inliers"] == pytest.approx(found["inliers"], abs=1e-7)


@pytest.mark.parametrize("far", [1e3, -1e3, 1e9, -1e9, 1e20, -1e20, np.inf, -np.inf, np.nan])
@pytest.mark.parametrize("at", [0, 31, 32, 40])
def test_a_point_far_from_the_map_has_no_surfel_at_any_batch_position(mixed, solved, far, at):
    """It takes the batch position of a point with weight 0, so all others keep theirs."""
    found = mixed.subset(np.arange(64))
    found.weight[at] = 0
    expected = solved(found, ONE_STEP)["matched"], solved(found, STILL)["inliers"]
    found.xyz[at] = far
    with np.errstate(invalid="ignore"):
        assert (solved(found, ONE_STEP)["matched"], solved(found, STILL)["inliers"]) == expected
