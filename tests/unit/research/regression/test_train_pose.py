import io

import numpy as np
import pytest
import torch

from research.baselines.regression import train_pose as module
from research.baselines.regression.googlenet import GoogLeNet, Pose
from research.baselines.regression.pictures import MapFrame, planes_of, poses_of
from research.baselines.regression.pose_loss import PoseLoss
from research.baselines.regression.train_pose import PoseRegressor, PoseSettings, train_pose
from service.errors import DatasetError

SMALL = PoseSettings(side=32, batch=4, point_every=10_000)


def test_a_few_pairs_are_learnt_by_heart(pairs_in_hall):
    torch.manual_seed(0)
    pairs, net, loss = pairs_in_hall(4), GoogLeNet(), PoseLoss()
    true = poses_of(pairs.T_map_camera, MapFrame.of(pairs.T_map_camera[:, :3, 3]))
    planes = planes_of(pairs, np.arange(4), 32)
    optimiser = torch.optim.AdamW([*net.parameters(), *loss.parameters()], lr=1e-3)
    losses = []
    for _ in range(10):
        total = loss(net(planes), Pose(*true)).mean()
        optimiser.zero_grad()
        total.backward()
        optimiser.step()
        losses.append(float(total.detach()))
    assert np.mean(losses[-3:]) < 0.8 * losses[0]


@pytest.fixture(scope="module")
def run_in_two_parts(pairs_in_hall, tmp_path_factory):
    """Return the pairs, and a folder with a training of half a second that continued from its checkpoint for another half."""
    folder, pairs = tmp_path_factory.mktemp("runs") / "googlenet", pairs_in_hall()
    first = train_pose(pairs, folder, SMALL, budget_s=0.5)
    second = train_pose(pairs, folder, SMALL, budget_s=first.curve[-1].processor_s + 0.5)
    return pairs, first, second


def test_a_run_goes_on_where_it_stopped(run_in_two_parts):
    _, first, second = run_in_two_parts
    assert second.curve[: len(first.curve)] == first.curve
    assert len(second.curve) > len(first.curve)
    steps = int(second.checkpoint()["optimiser"]["state"][0]["step"])
    assert steps * SMALL.batch == second.images


def test_a_run_ends_at_its_budget(run_in_two_parts):
    assert [training.ended for training in run_in_two_parts[1:]] == ["budget", "budget"]


def test_a_budget_that_is_spent_before_the_first_step_still_leaves_a_network(pairs_in_hall, tmp_path):
    training = train_pose(pairs_in_hall(), tmp_path / "run", SMALL, budget_s=1e-3)
    assert (training.images, training.ended) == (SMALL.batch, "budget")
    PoseRegressor.of(training)


def test_a_run_that_has_ended_is_left_alone(run_in_two_parts):
    pairs, _, second = run_in_two_parts
    again = train_pose(pairs, second.folder, SMALL, budget_s=second.curve[-1].processor_s)
    assert again.curve == second.curve


def test_the_best_network_answers_in_the_map(run_in_two_parts):
    pairs, _, second = run_in_two_parts
    T_map_camera = PoseRegressor.of(second).poses(pairs)
    assert T_map_camera.shape == (len(pairs), 4, 4)
    np.testing.assert_allclose(np.linalg.det(T_map_camera[:, :3, :3]), 1.0, atol=1e-6)
    assert np.abs(T_map_camera[:, :3, 3] - [30.0, 11.0, 1.6]).max() < 60.0


def test_a_restarted_training_continues_exactly(pairs_in_hall):
    """A step after a restart equals the step of an uninterrupted run."""
    pairs = pairs_in_hall()
    shown, frame = np.arange(len(pairs)), MapFrame.of(pairs.T_map_camera[:, :3, 3])
    straight = module.PoseLearner(pairs, frame, SMALL)
    straight.step(straight.draw(shown), 0.5)
    file = io.BytesIO()
    torch.save(straight.state(), file)
    file.seek(0)
    resumed = module.PoseLearner(pairs, frame, SMALL)
    resumed.restore(torch.load(file, weights_only=True))
    rows = straight.draw(shown)
    np.testing.assert_array_equal(rows, resumed.draw(shown))
    assert straight.step(rows, 0.5) == pytest.approx(resumed.step(rows, 0.5), rel=1e-4)


def test_a_run_of_other_settings_is_refused(run_in_two_parts):
    pairs, _, second = run_in_two_parts
    with pytest.raises(DatasetError, match="other settings"):
        train_pose(pairs, second.folder, PoseSettings(side=48), budget_s=2.5)


def test_threads_are_given_back_after_a_training(run_in_two_parts, pairs_in_hall, tmp_path):
    before = torch.get_num_threads()
    train_pose(pairs_in_hall(), tmp_path / "run", SMALL, budget_s=0.1)
    assert torch.get_num_threads() == before
