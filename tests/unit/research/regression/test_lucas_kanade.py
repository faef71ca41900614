import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from research.baselines.regression.lucas_kanade import (
    Alignment,
    aligned,
    alignment_loss,
    jacobian,
    moved,
    transform_of,
)
from research.baselines.regression.pointnet import PointNet


@pytest.fixture(scope="module")
def net():
    torch.manual_seed(3)
    return PointNet().double()


def clouds(count, points=240):
    """Return walls at right angles and a ground, of a size near 1."""
    rng = np.random.default_rng(5)
    found = rng.uniform(-1, 1, (count, points, 3))
    found[:, : points // 3, 0] = 0.9
    found[:, points // 3 : points // 2, 1] = -0.7
    found[:, points // 2 :, 2] = -0.1 + 0.05 * np.sin(5 * found[:, points // 2 :, 0])
    return torch.from_numpy(found)


def test_the_exponential_is_a_rotation_by_the_twist_s_length():
    twist = torch.tensor([0.0, 0.0, 0.0, 0.1, -0.4, 0.2], dtype=torch.float64)
    expected = Rotation.from_rotvec([0.1, -0.4, 0.2]).as_matrix()
    np.testing.assert_allclose(transform_of(twist)[:3, :3], expected, atol=1e-12)


def test_the_exponential_of_a_translation_is_that_translation():
    T = transform_of(torch.tensor([1.0, 2.0, 3.0, 0.0, 0.0, 0.0], dtype=torch.float64))
    np.testing.assert_allclose(T, [[1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]], atol=1e-12)


def test_features_do_not_depend_on_the_order_of_points(net):
    cloud = clouds(1)
    with torch.no_grad():
        np.testing.assert_allclose(net(cloud), net(cloud.flip(1)), atol=1e-12)


def test_the_jacobian_foretells_the_features_of_a_template_moved_back(net):
    template = clouds(1)
    twist = torch.tensor([2e-3, -1e-3, 1e-3, 1e-3, 2e-3, -1e-3], dtype=torch.float64)
    with torch.no_grad():
        features = net(template)
        change = net(moved(transform_of(-twist)[None], template)) - features
        foretold = jacobian(net, template, features) @ twist
    assert (change - foretold).norm() < 0.25 * change.norm()


@pytest.mark.parametrize("size", [0.02, 0.05, 0.1])
def test_a_known_perturbation_is_found_again(net, size):
    """Untrained features suffice if both clouds have the same points."""
    template = clouds(5)
    twists = torch.from_numpy(np.random.default_rng(1).normal(size=(5, 6))) * size
    T_true = transform_of(twists)
    source = moved(torch.linalg.inv(T_true), template)
    with torch.no_grad():
        found = aligned(net, template, source, iterations=20)
    before = (T_true - torch.eye(4)).norm(dim=(1, 2))
    after = (found.T_template_source - T_true).norm(dim=(1, 2))
    assert (after / before).median() < 0.1
    assert (found.residual.norm(dim=1) < found.first_residual.norm(dim=1)).all()


def test_a_source_that_lies_right_stays(net):
    template = clouds(2)
    with torch.no_grad():
        found = aligned(net, template, template)
    np.testing.assert_allclose(found.T_template_source, np.tile(np.eye(4), (2, 1, 1)), atol=1e-9)


def test_the_loss_is_the_distance_of_the_motions_and_of_the_features():
    T = torch.eye(4)[None].repeat(2, 1, 1)
    T[1, 0, 3] = 0.3
    residual = torch.tensor([[0.0, 0.0], [0.2, 0.4]])
    loss = alignment_loss(Alignment(T, residual, residual), torch.eye(4)[None].repeat(2, 1, 1))
    np.testing.assert_allclose(loss, [0.0, 0.09 + (0.04 + 0.16) / 2], rtol=1e-5)
