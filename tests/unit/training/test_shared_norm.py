import copy

import pytest

torch = pytest.importorskip("torch", reason="needs the extra `training`")

import torch.distributed as dist  # noqa: E402  # after the skip
from torch import nn  # noqa: E402
from torch._C._distributed_c10d import HashStore  # noqa: E402

from model_training.training.shared_norm import SharedBatchNorm2d, share_statistics  # noqa: E402


@pytest.fixture(scope="module")
def group():
    dist.init_process_group("gloo", store=HashStore(), rank=0, world_size=1)
    yield dist.group.WORLD
    dist.destroy_process_group()


def layers(group):
    torch.manual_seed(0)
    norm = nn.BatchNorm2d(5)
    nn.init.uniform_(norm.weight, 0.5, 2.0)
    nn.init.uniform_(norm.bias, -1.0, 1.0)
    plain = nn.Sequential(nn.Conv2d(3, 5, 3), norm, nn.ReLU())
    shared = copy.deepcopy(plain)
    share_statistics(shared, group)
    assert isinstance(shared[1], SharedBatchNorm2d)
    return plain, shared


@pytest.mark.parametrize("precision", [torch.float32, torch.bfloat16])
def test_one_process_gets_what_batch_normalisation_gives(group, precision):
    plain, shared = layers(group)
    tolerance = {"rtol": 1e-4, "atol": 1e-5} if precision == torch.float32 else {"rtol": 0.05, "atol": 0.05}
    for _ in range(2):
        images = 3 + 2 * torch.randn(4, 3, 8, 9)
        results = []
        for net in (plain, shared):
            net.zero_grad()
            x = images.clone().requires_grad_()
            with torch.autocast("cpu", torch.bfloat16, enabled=precision == torch.bfloat16):
                y = net(x)
            (y.float() ** 2 * torch.linspace(0, 1, y.numel()).reshape(y.shape)).mean().backward()
            results.append([y, x.grad, *(parameter.grad for parameter in net.parameters()), *net.buffers()])
        for one, other in zip(*results, strict=True):
            assert one.dtype == other.dtype
            torch.testing.assert_close(other, one, **tolerance)


def test_names_and_values_stay_those_of_the_plain_layer(group):
    plain, shared = layers(group)
    assert list(shared.state_dict()) == list(plain.state_dict())
    shared.eval()
    plain.eval()
    images = torch.randn(2, 3, 8, 9)
    torch.testing.assert_close(shared(images), plain(images), rtol=0, atol=0)
