import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the extra `training`")

from model_training.training.memory import DescriptorMemory  # noqa: E402  # after the skip


@pytest.fixture
def memory():
    """Return six pairs, 50 m apart. Survey view k is most similar to query k, then to k + 1, then to the others."""
    held = DescriptorMemory(8, 6, torch.device("cpu"))
    xy = torch.arange(6.0)[:, None] * torch.tensor([50.0, 0.0])
    queries = torch.nn.functional.normalize(torch.eye(6) + 0.5 * torch.roll(torch.eye(6), 1, dims=1), dim=1)
    held.keep(np.arange(6), queries, torch.eye(6), xy, xy, step=10)
    return held


def test_a_never_sampled_view_is_never_recent(memory):
    assert memory.recent(10, 10**6).tolist() == [0, 1, 2, 3, 4, 5]


def test_old_descriptors_are_left_out(memory):
    memory.keep(np.array([2]), torch.ones(1, 6), torch.ones(1, 6), torch.zeros(1, 2), torch.zeros(1, 2), step=30)
    assert memory.recent(35, 10).tolist() == [2]


def test_the_perceptual_alias_of_another_place_is_found(memory):
    assert memory.hard_negatives(np.array([1]), np.arange(6), each=1).tolist() == [1, 2]


def test_views_of_the_same_place_are_no_hard_negatives(memory):
    memory.surveys_xy[2] = memory.queries_xy[1] + 2.0
    assert 2 not in memory.hard_negatives(np.array([1]), np.array([0, 1, 2, 4]), each=2)


def test_kept_descriptors_do_not_hold_the_graph(memory):
    weights = torch.ones(1, 6, requires_grad=True)
    memory.keep(np.array([0]), weights * 2, weights * 3, torch.zeros(1, 2), torch.zeros(1, 2), step=11)
    assert not memory.queries.requires_grad
    np.testing.assert_array_equal(memory.queries[0].numpy(), 2.0)


def test_a_state_comes_back(memory):
    other = DescriptorMemory(8, 6, torch.device("cpu"))
    other.restore(memory.state())
    assert other.recent(10, 5).tolist() == memory.recent(10, 5).tolist()
    torch.testing.assert_close(other.surveys, memory.surveys)
