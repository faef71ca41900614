from dataclasses import replace

import numpy as np
import pytest
import torch

from research.baselines.regression import train_lk as module
from research.baselines.regression.map_cloud import MapCloud
from research.baselines.regression.train_lk import LkSettings, load_lk, train_lk, wrong_poses
from service.errors import DatasetError

SMALL = LkSettings(batch=4, points=128, iterations=3, point_every=40, watched=8, level_m=1.0, yaw_rad=0.05)


@pytest.fixture(scope="module")
def run_in_two_parts(pairs_in_hall, hall, tmp_path_factory):
    folder, pairs = tmp_path_factory.mktemp("runs") / "lk", pairs_in_hall()
    first = train_lk(pairs, hall, folder, SMALL, budget_s=1.0)
    second = train_lk(pairs, hall, folder, SMALL, budget_s=first.curve[-1].processor_s + 1.0)
    return first, second


def test_a_run_goes_on_where_it_stopped(run_in_two_parts):
    first, second = run_in_two_parts
    assert second.curve[: len(first.curve)] == first.curve
    assert len(second.curve) > len(first.curve)
    assert int(second.checkpoint()["optimiser"]["state"][0]["step"]) * SMALL.batch == second.images
    assert second.ended == "budget"


def test_a_batch_is_learnt_by_heart(pairs_in_hall, hall):
    learner = module._Learner(pairs_in_hall(), hall, replace(SMALL, seed=2))
    batch = learner.draw(np.arange(12))
    losses = [learner.step(batch, 0.02) for _ in range(40)]
    assert np.mean(losses[-5:]) < 0.6 * losses[0]


def test_the_best_network_is_read_back(run_in_two_parts):
    net = load_lk(run_in_two_parts[1])
    with torch.no_grad():
        assert net(torch.zeros(1, 5, 3)).shape == (1, 512)


def test_wrong_poses_have_the_requested_error():
    T = np.tile(np.eye(4), (4000, 1, 1))
    off = wrong_poses(T, replace(SMALL, level_m=2.0, yaw_rad=0.0, tilt_rad=0.0), np.random.default_rng(0))
    np.testing.assert_allclose(off[:, :3, 3].std(axis=0), [2.0, 0.3, 2.0], rtol=0.05)


def test_a_map_of_another_city_teaches_nothing(pairs_in_hall, hall, tmp_path):
    far = MapCloud(hall.points_map + 1e4)
    with pytest.raises(DatasetError, match="overlaps the map"):
        train_lk(pairs_in_hall(), far, tmp_path / "run", SMALL, budget_s=1.0)
