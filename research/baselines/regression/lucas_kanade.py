"""PointNetLK: inverse-compositional alignment of Lucas and Kanade on PointNet features (Aoki et al., CVPR 2019).

Twists are translation first, then rotation (rad). Lengths are in the clouds' own unit.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from research.baselines.regression.pointnet import PointNet

STEP = 1e-2  # step of the finite differences, as published
ITERATIONS = 10
#: Damping relative to the mean diagonal of J'J. A cloud may leave one of the six motions unobservable.
DAMPING = 1e-4


@dataclass(frozen=True, slots=True)
class Alignment:
    """The motion that was found, and the remaining feature difference.

    Attributes:
        T_template_source: motions (B, 4, 4).
        residual: features of the moved source minus those of the template (B, F).
        first_residual: features of the given source minus those of the template (B, F).
    """

    T_template_source: Tensor
    residual: Tensor
    first_residual: Tensor


def transform_of(twist: Tensor) -> Tensor:
    """Compute the exponential map of SE(3), (..., 4, 4).

    Args:
        twist: twists (..., 6).
    """
    x, y, z, a, b, c = twist.unbind(-1)
    o = torch.zeros_like(x)
    rows = [(o, -c, b, x), (c, o, -a, y), (-b, a, o, z), (o, o, o, o)]
    found: Tensor = torch.linalg.matrix_exp(torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2))
    return found


def moved(T: Tensor, points: Tensor) -> Tensor:
    """Transform points (..., N, 3).

    Args:
        T: transforms (..., 4, 4).
        points: points (..., N, 3).
    """
    return points @ T[..., :3, :3].transpose(-1, -2) + T[..., None, :3, 3]


def jacobian(net: PointNet, template: Tensor, features: Tensor) -> Tensor:
    """Compute the derivative (B, F, 6) of the template's features by the inverse of a twist, by finite differences.

    Args:
        net: network of the features.
        template: points (B, N, 3).
        features: features of the template (B, F).
    """
    back = transform_of(-STEP * torch.eye(6, dtype=template.dtype))  # (6, 4, 4)
    turned = moved(back[None], template[:, None])  # (B, 6, N, 3)
    each = net(turned.flatten(0, 1)).unflatten(0, turned.shape[:2])
    found: Tensor = ((each - features[:, None]) / STEP).transpose(1, 2)
    return found


def aligned(net: PointNet, template: Tensor, source: Tensor, *, iterations: int = ITERATIONS) -> Alignment:
    """Find the motion that takes each source to its template.

    The Jacobian belongs to the fixed template. It and the matrix of the step are therefore computed once.

    Args:
        net: network of the features.
        template: points (B, N, 3).
        source: points (B, M, 3).
        iterations: number of steps.
    """
    wanted = net(template)
    J = jacobian(net, template, wanted)
    normal = J.transpose(1, 2) @ J
    damping = DAMPING * normal.diagonal(dim1=1, dim2=2).mean(dim=1) + torch.finfo(normal.dtype).tiny
    solve = torch.linalg.solve(normal + damping[:, None, None] * torch.eye(6, dtype=normal.dtype), J.transpose(1, 2))
    T = torch.eye(4, dtype=source.dtype).expand(len(source), 4, 4)
    first = residual = net(source) - wanted
    for _ in range(iterations):
        T = transform_of((solve @ residual[..., None])[..., 0]) @ T
        residual = net(moved(T, source)) - wanted
    return Alignment(T, residual, first)


def alignment_loss(found: Alignment, T_true: Tensor) -> Tensor:
    """Compute the published loss (B,): ||T_found T_true^-1 - I|| and the mean square of the feature difference.

    Args:
        found: result of the alignment.
        T_true: ground-truth motions (B, 4, 4).
    """
    identity = torch.eye(4, dtype=T_true.dtype)
    apart = (found.T_template_source @ torch.linalg.inv(T_true) - identity).square().sum(dim=(1, 2))
    loss: Tensor = apart + found.residual.square().mean(dim=1)
    return loss
