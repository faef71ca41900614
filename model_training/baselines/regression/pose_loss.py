"""The loss of a regressed pose.

PoseNet (Kendall et al., 2015) adds the errors of position and quaternion with a fixed factor beta, to be searched for on every
scene. Here the weights are learned with the network, as the homoscedastic uncertainty of either (Kendall and Cipolla, CVPR 2017),
since a search would cost more than the training is given.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from model_training.baselines.regression.googlenet import Pose

AUXILIARY_WEIGHT = 0.3  # of each auxiliary head, as PoseNet and GoogLeNet have it
FIRST_LOG_VARIANCES = (0.0, -3.0)  # position, quaternion; where Kendall and Cipolla begin


def pose_errors(found: Pose, true: Pose) -> tuple[Tensor, Tensor]:
    """Distance of the positions (B, normalised) and of the quaternions (B), a quaternion and its negative being one rotation."""
    apart = torch.linalg.vector_norm(found.quaternion - true.quaternion, dim=1)
    opposite = torch.linalg.vector_norm(found.quaternion + true.quaternion, dim=1)
    return torch.linalg.vector_norm(found.position - true.position, dim=1), torch.minimum(apart, opposite)


class PoseLoss(nn.Module):
    """exp(-s) * error + s for position and quaternion, both s learned; the same two for all heads."""

    def __init__(self) -> None:
        super().__init__()
        self.log_variances = nn.Parameter(torch.tensor(FIRST_LOG_VARIANCES))

    def forward(self, heads: Sequence[Pose], true: Pose) -> Tensor:
        """Loss of each example (B): the first head's, and 0.3 of each other's."""
        total = torch.zeros(len(true.position))
        for weight, found in zip([1.0] + [AUXILIARY_WEIGHT] * (len(heads) - 1), heads, strict=True):
            for error, log_variance in zip(pose_errors(found, true), self.log_variances, strict=True):
                total = total + weight * (torch.exp(-log_variance) * error + log_variance)
        return total
