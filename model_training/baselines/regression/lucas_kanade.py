"""PointNetLK: Lucas and Kanade's inverse-compositional alignment on the features of PointNet (Aoki et al., CVPR 2019).

Twists are translation first, then rotation (rad); lengths are in the clouds' own unit.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from model_training.baselines.regression.pointnet import PointNet

STEP = 1e-2  # of the finite differences, as published
ITERATIONS = 10
DAMPING = 1e-4  # of the mean diagonal of J'J: clouds may hold nothing against which one of six motions shows


@dataclass(frozen=True, slots=True)
class Alignment:
    """The motion found, and what is left of the features.

    ``T_template_source`` (B, 4, 4); ``residual`` and ``first_residual`` (B, F): features of the source, as it was found and as it
    was given, less the template's.
    """

    T_template_source: Tensor
    residual: Tensor
    first_residual: Tensor


def transform_of(twist: Tensor) -> Tensor:
    """Exponential map of SE(3): (..., 6) to (..., 4, 4)."""
    x, y, z, a, b, c = twist.unbind(-1)
    o = torch.zeros_like(x)
    rows = [(o, -c, b, x), (c, o, -a, y), (-b, a, o, z), (o, o, o, o)]
    found: Tensor = torch.linalg.matrix_exp(torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2))
    return found


def moved(T: Tensor, points: Tensor) -> Tensor:
    """Points (..., N, 3) through T (..., 4, 4)."""
    return points @ T[..., :3, :3].transpose(-1, -2) + T[..., None, :3, 3]


def jacobian(net: PointNet, template: Tensor, features: Tensor) -> Tensor:
    """How the template's features (B, F) change as it moves by a twist, backwards: (B, F, 6), by finite differences."""
    back = transform_of(-STEP * torch.eye(6, dtype=template.dtype))  # (6, 4, 4)
    turned = moved(back[None], template[:, None])  # (B, 6, N, 3)
    each = net(turned.flatten(0, 1)).unflatten(0, turned.shape[:2])
    found: Tensor = ((each - features[:, None]) / STEP).transpose(1, 2)
    return found


def aligned(net: PointNet, template: Tensor, source: Tensor, *, iterations: int = ITERATIONS) -> Alignment:
    """Find the motion that takes each source to its template.

    The Jacobian is of the template where it lies, so it and the matrix that solves for a step are computed once.

    Args:
        net: its features.
        template: (B, N, 3).
        source: (B, M, 3).
        iterations: steps.
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
    """As published: ||T_found T_true^-1 - I|| and the mean square of what is left of the features; each cloud's (B)."""
    identity = torch.eye(4, dtype=T_true.dtype)
    apart = (found.T_template_source @ torch.linalg.inv(T_true) - identity).square().sum(dim=(1, 2))
    loss: Tensor = apart + found.residual.square().mean(dim=1)
    return loss
