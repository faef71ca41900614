"""The derivatives of the kernel against numerical ones. Surfels are so sparse that each point keeps its own."""

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from service.registration.kernel import SURFEL, Piece, QueryPoints, SolverOptions, align, gradients, packed_map

UNKNOWNS = ["x", "y", "z", "roll", "pitch", "yaw", "log scale", "disparity offset"]
FREE: dict[str, Any] = {"reach": 1.0, "robust_first": 1e6, "robust_last": 1e6, "prior_weight": 0.0, "free_offset": True}


class Problem:
    """64 surfels 4 m apart with random normals, one point near each, and the pose, scale and offset that place it there."""

    def __init__(self, seed, *, off_m=0.0):
        rng = np.random.default_rng(seed)
        cells = np.stack(np.meshgrid(*[np.arange(4.0)] * 3), axis=-1).reshape(-1, 3)
        surfels = np.zeros(len(cells), SURFEL)
        surfels["xyz"] = 4 * cells + rng.uniform(-0.5, 0.5, cells.shape)
        normals = rng.normal(size=cells.shape)
        surfels["normal"] = normals / np.linalg.norm(normals, axis=1, keepdims=True)
        surfels["thickness_m"] = rng.uniform(0, 0.05, len(cells))
        self.grid, self.packed, order = packed_map(surfels, cell_m=0.3, reach_m=1.2)
        self.surfels = self.grid.unpacked(self.packed, np.argsort(order))  # in the given order
        self.R = Rotation.random(random_state=seed).as_matrix()
        self.t = rng.uniform(-3, 15, 3)
        self.log_scale, self.offset = rng.uniform(-0.05, 0.05), rng.uniform(-0.1, 0.1)
        q = rng.uniform(0, 1, len(cells))
        stretch = np.exp(self.log_scale) / (1 + self.offset * q)
        there = self.surfels["xyz"] + rng.uniform(-off_m, off_m, cells.shape)
        rays, f = rng.normal(size=cells.shape), np.float32
        self.points = QueryPoints(
            ((there - self.t) @ self.R / stretch[:, None]).astype(f),
            (rays / np.linalg.norm(rays, axis=1, keepdims=True)).astype(f),
            rng.uniform(0.01, 0.1, len(cells)).astype(f),
            rng.uniform(0.5, 2, len(cells)).astype(f),
            q.astype(f),
        )

    def residuals(self, change):
        """Return the distance of each point from the plane of its surfel after a change of the unknowns."""
        R = Rotation.from_rotvec(change[3:6]).as_matrix() @ self.R
        stretch = np.exp(self.log_scale + change[6]) / (1 + (self.offset + change[7]) * self.points.q.astype(float))
        there = stretch[:, None] * self.points.xyz.astype(float) @ R.T + self.t + change[:3]
        return ((there - self.surfels["xyz"]) * self.surfels["normal"].astype(float)).sum(axis=1)

    def jacobian(self):
        steps = 1e-5 * np.eye(8)
        return np.stack([(self.residuals(step) - self.residuals(-step)) / 2e-5 for step in steps], axis=1)

    def ratios(self):
        """Return the range at which the ray through each point hits the plane of its surfel, divided by the range of the point."""
        stretch = np.exp(self.log_scale) / (1 + self.offset * self.points.q.astype(float))
        measured = stretch[:, None] * self.points.xyz.astype(float) @ self.R.T
        normal = self.surfels["normal"].astype(float)
        return ((self.surfels["xyz"] - self.t) * normal).sum(axis=1) / (measured * normal).sum(axis=1)

    def weights(self, surface_m):
        along = self.points.sigma * (self.surfels["normal"] * (self.points.ray @ self.R.T)).sum(axis=1)
        along2 = along**2 * self.ratios().clip(0.5, 2) ** 3
        return self.points.weight / (along2 + surface_m**2 + self.surfels["thickness_m"] ** 2)

    def state(self, start_at, *, change=None):
        change = np.zeros(8) if change is None else change
        R = Rotation.from_rotvec(change[3:6]).as_matrix() @ self.R
        return start_at(R, self.t + change[:3], log_scale=self.log_scale + change[6], offset=self.offset + change[7])

    def aligned(self, start_at, *, change=None, **options):
        state = self.state(start_at, change=change)
        align((Piece(self.grid, self.packed),), self.points, state, SolverOptions(**(FREE | options)))
        return state[0]

    def away(self, state):
        """Return the unknowns of a state minus the true ones."""
        turn = Rotation.from_matrix(state["R"] @ self.R.T).as_rotvec()
        return np.array(
            [*(state["t"] - self.t), *turn, state["log_scale"] - self.log_scale, state["offset"] - self.offset]
        )


@pytest.mark.parametrize("seed", range(4))
def test_the_information_is_that_of_numerical_derivatives(start_at, seed):
    problem = Problem(seed, off_m=0.3)
    J = problem.jacobian()
    expected = J.T * problem.weights(0.05) @ J
    found = problem.aligned(start_at, iterations=1, surface=0.05)["information"]
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(found / scale, expected / scale, atol=1e-5)
    coupled = np.abs(expected / scale) - np.eye(8)
    assert (coupled.max(axis=1) > 0.1).all()  # or a sign could hide


@pytest.mark.parametrize("seed", range(4))
def test_a_step_is_that_of_gauss_and_newton(start_at, seed):
    problem = Problem(seed, off_m=0.05)
    J, w = problem.jacobian(), problem.weights(0.05)
    damped = J.T * w @ J + np.diag([0, 0, 0, *[1e-3 * len(w)] * 3, 0, 0])
    expected = np.linalg.solve(damped, -J.T @ (w * problem.residuals(np.zeros(8))))
    found = problem.away(problem.aligned(start_at, iterations=1, surface=0.05))
    np.testing.assert_allclose(found, expected, atol=1e-3 * np.abs(expected).max())
    assert np.abs(expected).min() > 1e-4


@pytest.mark.parametrize("seed", range(4))
def test_the_gradient_of_a_patch_equals_the_numerical_one(start_at, seed):
    """Six patches with points in random order, and a seventh patch without points."""
    problem = Problem(seed, off_m=0.3)
    patch = np.random.default_rng(seed).integers(0, 6, len(problem.surfels)).astype(np.int32)
    patch[5] = 7
    each = (problem.weights(0.05) * problem.residuals(np.zeros(8)))[:, None] * problem.jacobian()
    expected = np.stack([each[patch == number].sum(axis=0) for number in range(8)])
    state, options = problem.state(start_at), SolverOptions(**FREE, iterations=1, surface=0.05)
    before = state.tobytes()
    found = gradients((Piece(problem.grid, problem.packed),), problem.points, state, options, patch)
    size = np.abs(each).sum(axis=0)
    np.testing.assert_allclose(found / size, expected / size, atol=1e-5)
    assert (found[6] == 0).all()
    assert (np.abs(expected / size).max(axis=0) > 0.03).all()  # or a sign could hide
    assert state.tobytes() == before


@pytest.mark.parametrize("seed", range(4))
def test_the_sum_of_the_gradients_gives_the_solver_step(start_at, seed):
    """The step of the solver, with its information and the damping of 0.001 per point on rotations."""
    problem = Problem(seed, off_m=0.05)
    state, options = problem.state(start_at), SolverOptions(**FREE, iterations=1, surface=0.05)
    count = len(problem.surfels)
    found = gradients(
        (Piece(problem.grid, problem.packed),), problem.points, state, options, np.arange(count, dtype=np.int32) % 9
    )
    moved = problem.aligned(start_at, iterations=1, surface=0.05)
    damping = np.diag([0, 0, 0, *[1e-3 * problem.points.weight.sum()] * 3, 0, 0])
    step = problem.away(moved)
    expected = -(moved["information"] + damping) @ step
    np.testing.assert_allclose(found.sum(axis=0), expected, atol=1e-4 * np.abs(expected).max())


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("unknown", range(8), ids=UNKNOWNS)
def test_a_small_change_of_one_unknown_is_undone_in_one_step(start_at, unknown, sign):
    problem = Problem(9)
    size = [0.02, 0.02, 0.02, 0.002, 0.002, 0.002, 0.002, 0.005][unknown]
    change = sign * size * np.eye(8)[unknown]
    found = problem.away(problem.aligned(start_at, change=change, iterations=1))
    np.testing.assert_allclose(found, 0, atol=0.05 * size)


def test_a_change_of_everything_is_undone_in_a_few_steps(start_at):
    problem = Problem(10)
    change = np.array([0.1, -0.1, 0.1, 0.01, -0.01, 0.01, 0.005, -0.02])
    found = problem.away(problem.aligned(start_at, change=change, iterations=10))
    np.testing.assert_allclose(found, 0, atol=1e-4)


@pytest.mark.parametrize(
    ("robust_m", "expected"), [(1e6, 100.0), (0.3, 100 * (0.13 / 0.14) ** 2), (1e-6, 100 * (0.04 / 0.05) ** 2)]
)
def test_a_point_off_its_surface_informs_the_less_the_narrower_the_robust_width(
    points_at, start_at, robust_m, expected
):
    """Error 0.1 m and variance 0.1^2: the squared width is 4 x 0.01 plus the square of the robust width."""
    surfels = np.zeros(1, SURFEL)
    surfels["normal"] = [1, 0, 0]
    grid, packed, _ = packed_map(surfels, cell_m=0.3, reach_m=1.2)
    state = start_at(np.eye(3), [-5, 0, 0])
    options = SolverOptions(**(FREE | {"robust_first": robust_m, "robust_last": robust_m}), iterations=1, surface=0.1)
    align((Piece(grid, packed),), points_at([[5.1, 0, 0]], sigma=0.0), state, options)
    assert state["information"][0, 0, 0] == pytest.approx(expected, rel=1e-4)
