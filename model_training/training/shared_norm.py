"""Batch normalisation with the statistics of the batch of all processes.

``torch.nn.SyncBatchNorm`` computes the same, but only on GPUs. This layer also runs on CPUs over gloo.
"""

from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.nn import functional


class SharedBatchNorm2d(nn.BatchNorm2d):
    """Batch normalisation over the batches of all processes.

    Parameters, running statistics and their names are those of ``BatchNorm2d``.

    Args:
        norm: layer whose parameters and running statistics this layer takes over; momentum must not be None.
        group: group of the processes.
    """

    def __init__(self, norm: nn.BatchNorm2d, group: dist.ProcessGroup) -> None:
        super().__init__(norm.num_features, norm.eps, norm.momentum)
        self.weight, self.bias = norm.weight, norm.bias
        self.running_mean, self.running_var = norm.running_mean, norm.running_var
        self.num_batches_tracked = norm.num_batches_tracked
        self._group = group

    def forward(self, x: Tensor) -> Tensor:
        """Normalise a batch.

        Args:
            x: (B, C, rows, columns).

        Returns:
            Normalised values, of the same shape and type.
        """
        if not self.training:
            return super().forward(x)
        result: tuple[Tensor, Tensor, Tensor, Tensor] = _Normalise.apply(  # type: ignore[no-untyped-call]  # torch leaves it untyped
            x, self.weight, self.bias, self.eps, self._group
        )
        y, mean, variance, count = result
        with torch.no_grad():
            share = 0.1 if self.momentum is None else self.momentum
            for running, value in ((self.running_mean, mean), (self.running_var, variance * count / (count - 1))):
                if running is not None:
                    running.lerp_(value, share)
            if self.num_batches_tracked is not None:
                self.num_batches_tracked += 1
        return y


def share_statistics(net: nn.Module, group: dist.ProcessGroup) -> None:
    """Replace every ``BatchNorm2d`` of a network by one that uses the batches of all processes.

    Args:
        net: network; changed in place.
        group: group of the processes.
    """
    for parent in list(net.modules()):
        for name, child in list(parent.named_children()):
            if isinstance(child, nn.BatchNorm2d):
                setattr(parent, name, SharedBatchNorm2d(child, group))


class _Normalise(torch.autograd.Function):
    """Normalise with common statistics. Returns also mean, biased variance (C) and the number of values per channel."""

    @staticmethod
    def forward(
        ctx: Any, x: Tensor, weight: Tensor, bias: Tensor, eps: float, group: dist.ProcessGroup
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        channels = x.shape[1]
        variance, mean = torch.var_mean(x.float(), dim=(0, 2, 3), correction=0)
        own = torch.cat([mean, variance, mean.new_tensor([x.numel() // channels])])
        parts = [torch.empty_like(own) for _ in range(dist.get_world_size(group))]
        dist.all_gather(parts, own, group=group)
        joined = torch.stack(parts)
        means, variances, counts = joined[:, :channels], joined[:, channels:-1], joined[:, -1:]
        count = counts.sum()
        # Parts with their own mean and variance join without cancellation (Chan et al., 1983).
        mean = (means * counts).sum(dim=0) / count
        variance = ((variances + (means - mean) ** 2) * counts).sum(dim=0) / count
        ctx.eps, ctx.group = eps, group
        ctx.save_for_backward(x, weight, mean, variance, count)
        ctx.mark_non_differentiable(mean, variance, count)
        return functional.batch_norm(x, mean, variance, weight, bias, False, 0.0, eps), mean, variance, count

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, Tensor, None, None]:
        x, weight, mean, variance, count = ctx.saved_tensors
        # Constant statistics first: weight / deviation * gradient, and the sums that are the gradients of weight and bias.
        of_x, of_weight, of_bias = torch.ops.aten.native_batch_norm_backward(
            gradients[0], x, weight, mean, variance, None, None, False, ctx.eps, [True, True, True]
        )
        sums = torch.stack([of_weight, of_bias])
        dist.all_reduce(sums, group=ctx.group)
        inverse = torch.rsqrt(variance + ctx.eps)
        # Then the part of the statistics: -weight / deviation * (sum of gradients + normalised x * sum of products) / count.
        slope = -weight * inverse**2 * sums[0] / count
        offset = -weight * inverse * sums[1] / count - slope * mean
        through = torch.addcmul(offset.reshape(1, -1, 1, 1), x.float(), slope.reshape(1, -1, 1, 1))
        return through.add_(of_x).to(x.dtype), of_weight, of_bias, None, None
