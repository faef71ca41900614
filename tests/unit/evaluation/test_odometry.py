import numpy as np
import pytest

from model_training.evaluation import odometry
from model_training.evaluation.odometry import as_query
from service.geometry.rigid import inverse
from service.imaging.view_grid import ViewGrid

GRID = ViewGrid(rows=8, columns=16)


@pytest.fixture
def frames(small_dataset):
    return list(small_dataset.queries("drive1_precise"))[:4]


def test_the_last_frame_comes_first_and_is_the_reference(frames):
    queries, poses = as_query(frames, np.random.default_rng(0), grid=GRID, ranked=3)
    assert len(queries) == len(poses) == 4
    np.testing.assert_array_equal(poses[0], np.eye(4))
    for query, frame in zip(queries, frames[::-1], strict=True):
        np.testing.assert_array_equal(query.depth_m, frame.depth_m())
        np.testing.assert_array_equal(query.rgb, frame.rgb())


def test_without_errors_the_odometry_is_the_truth(frames, monkeypatch):
    monkeypatch.setattr(odometry, "_WAY", 0.0)
    monkeypatch.setattr(odometry, "_TURN_RAD", 0.0)
    _, poses = as_query(frames, np.random.default_rng(0), grid=GRID, ranked=3)
    for T, frame in zip(poses, frames[::-1], strict=True):
        np.testing.assert_allclose(T, inverse(frames[-1].T_map_camera) @ frame.T_map_camera, atol=1e-9)


def test_the_odometry_errs_by_a_hundredth_of_the_way_and_a_fifth_of_a_degree(frames):
    """The first step back, repeated 400 times."""
    truth = inverse(frames[-1].T_map_camera) @ frames[-2].T_map_camera
    way_m = np.linalg.norm(truth[:3, 3])
    steps = [as_query(frames[-2:], np.random.default_rng(seed), grid=GRID, ranked=3)[1][1] for seed in range(400)]
    errors = np.array([inverse(truth) @ step for step in steps])
    np.testing.assert_allclose(errors[:, :3, 3].std(axis=0), 0.01 * way_m, rtol=0.15)
    assert np.rad2deg(np.arctan2(errors[:, 0, 2], errors[:, 0, 0])).std() == pytest.approx(0.2, rel=0.15)


def test_exact_odometry_is_the_truth(frames):
    _, poses = as_query(frames, np.random.default_rng(0), grid=GRID, ranked=3, exact=True)
    for T, frame in zip(poses, frames[::-1], strict=True):
        np.testing.assert_allclose(T, inverse(frames[-1].T_map_camera) @ frame.T_map_camera, atol=1e-9)
