"""Loss of a regressed pose.

PoseNet (Kendall et al., 2015) adds the errors of position and quaternion with a fixed factor beta, which needs a search
for every scene. Here the network learns the weights as the homoscedastic uncertainty of both errors (Kendall and
Cipolla, CVPR 2017). A search would cost more than the training budget.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from research.baselines.regression.googlenet import Pose

#: Weight of each auxiliary head, as in PoseNet and GoogLeNet.
AUXILIARY_WEIGHT = 0.3
FIRST_LOG_VARIANCES = (0.0, -3.0)  # position, quaternion; as in Kendall and Cipolla


def pose_errors(found: Pose, true: Pose) -> tuple[Tensor, Tensor]:
    """Return the distances of positions (B,), normalised, and of quaternions (B,); q and -q are the same rotation.

    Args:
        found: poses of a head.
        true: ground-truth poses.
    """
    apart = torch.linalg.vector_norm(found.quaternion - true.quaternion, dim=1)
    opposite = torch.linalg.vector_norm(found.quaternion + true.quaternion, dim=1)
    return torch.linalg.vector_norm(found.position - true.position, dim=1), torch.minimum(apart, opposite)


class PoseLoss(nn.Module):
    """The loss exp(-s) * error + s for position and quaternion; both s are learned and shared by all heads."""

    def __init__(self) -> None:
        super().__init__()
        self.log_variances = nn.Parameter(torch.tensor(FIRST_LOG_VARIANCES))

    def forward(self, heads: Sequence[Pose], true: Pose) -> Tensor:
        """Compute the loss of each example (B,): that of the first head, and 0.3 of each other head's.

        Args:
            heads: poses of all heads.
            true: ground-truth poses.
        """
        total = torch.zeros(len(true.position))
        for weight, found in zip([1.0] + [AUXILIARY_WEIGHT] * (len(heads) - 1), heads, strict=True):
            for error, log_variance in zip(pose_errors(found, true), self.log_variances, strict=True):
                total = total + weight * (torch.exp(-log_variance) * error + log_variance)
        return total
