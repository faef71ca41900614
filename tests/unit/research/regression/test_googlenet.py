import numpy as np
import pytest
import torch

from research.baselines.regression.googlenet import GoogLeNet, Inception, Pose
from research.baselines.regression.pose_loss import PoseLoss, pose_errors


@pytest.fixture(scope="module")
def net():
    torch.manual_seed(0)
    return GoogLeNet()


def test_an_inception_block_puts_its_branches_side_by_side():
    block = Inception(192, (64, 96, 128, 16, 32, 32))
    assert block(torch.zeros(2, 192, 5, 7)).shape == (2, 256, 5, 7)
    assert block.outputs == 256


def test_the_network_is_as_wide_as_published(net):
    """Table 1 of the paper: 1,024 features before the last layer, and about 6 million weights without the heads."""
    heads = ("head.", "auxiliary.")
    weights = sum(p.numel() for name, p in net.named_parameters() if not name.startswith(heads) and p.dim() == 4)
    biases = 64 * 7 * 7  # the fourth plane's
    assert net.head.hidden[0].in_features == 1024
    assert abs(weights - biases - 5_973_000) < 10_000


@pytest.mark.parametrize("side", [32, 96])
def test_three_heads_answer_while_training_and_one_afterwards(net, side):
    planes = torch.zeros(2, 4, side, side)
    with torch.no_grad():
        assert [tuple(each.position.shape) for each in net.train()(planes)] == [(2, 3)] * 3
        answers = net.eval()(planes)
    assert len(answers) == 1
    assert answers[0].quaternion.shape == (2, 4)


def test_quaternions_are_of_length_one(net):
    with torch.no_grad():
        found = net.eval()(torch.rand(3, 4, 32, 32, generator=torch.Generator().manual_seed(1)))
    np.testing.assert_allclose(found[0].quaternion.norm(dim=1), 1.0, atol=1e-6)


def pose(position, quaternion):
    return Pose(torch.tensor([position]), torch.tensor([quaternion]))


TRUE = pose([0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0])
OFF = pose([0.3, 0.0, 0.4], [0.6, 0.0, 0.0, 0.8])  # 0.5 away; the quaternions sqrt(0.36 + 0.04) apart


def test_errors_are_euclidean_distances():
    position, quaternion = pose_errors(OFF, TRUE)
    assert position.item() == pytest.approx(0.5)
    assert quaternion.item() == pytest.approx(0.4**0.5)


def test_a_quaternion_and_its_negative_are_one_rotation():
    _, apart = pose_errors(pose([0.0] * 3, [0.0, 0.0, 0.0, -1.0]), TRUE)
    assert apart.item() == 0.0


def test_errors_are_weighted_by_their_learned_variances():
    loss = PoseLoss()
    expected = 0.5 + (np.exp(3.0) * 0.4**0.5 - 3.0)
    assert loss([OFF], TRUE).item() == pytest.approx(expected, rel=1e-5)
    with torch.no_grad():
        loss.log_variances.copy_(torch.tensor([1.0, 2.0]))
    assert loss([OFF], TRUE).item() == pytest.approx(np.exp(-1) * 0.5 + 1 + np.exp(-2) * 0.4**0.5 + 2, rel=1e-5)


def test_each_auxiliary_head_counts_three_tenths():
    loss = PoseLoss()
    alone, all_three = loss([OFF], TRUE).item(), loss([OFF, OFF, OFF], TRUE).item()
    assert all_three == pytest.approx(1.6 * alone, rel=1e-5)


def test_the_best_variance_is_the_error_itself():
    """d/ds (exp(-s) e + s) = 0 at exp(s) = e."""
    loss = PoseLoss()
    with torch.no_grad():
        loss.log_variances.copy_(torch.log(torch.tensor([0.5, 0.4**0.5])))
    loss([OFF], TRUE).sum().backward()
    assert loss.log_variances.grad is not None
    np.testing.assert_allclose(loss.log_variances.grad, 0.0, atol=1e-6)
