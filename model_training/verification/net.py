"""The network of the verifier: seven convolutions, then the mean and the largest value of each channel."""

import torch
from jaxtyping import Float32
from torch import nn

from service.scoring.comparison import PLANES

#: Channels of the first block; the others have two, three and four times as many.
WIDTH = 24
_DROPOUT = 0.3
_HIDDEN = 64


def _block(inputs: int, outputs: int, stride: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False), nn.BatchNorm2d(outputs), nn.ReLU(inplace=True)
    )


class VerifierNet(nn.Module):
    """Log odds that the pose of a comparison is right.

    Args:
        width: channels of the first block.
    """

    def __init__(self, width: int = WIDTH) -> None:
        super().__init__()
        self.features = nn.Sequential(
            _block(len(PLANES), width, 2),
            _block(width, width, 1),
            _block(width, 2 * width, 2),
            _block(2 * width, 2 * width, 1),
            _block(2 * width, 3 * width, 2),
            _block(3 * width, 3 * width, 1),
            _block(3 * width, 4 * width, 2),
        )
        self.head = nn.Sequential(
            nn.Linear(8 * width, _HIDDEN), nn.ReLU(inplace=True), nn.Dropout(_DROPOUT), nn.Linear(_HIDDEN, 1)
        )

    def forward(self, comparison: Float32[torch.Tensor, "n 12 64 128"]) -> Float32[torch.Tensor, " n"]:
        """Compute the log odds.

        Args:
            comparison: planes of ``service.scoring.comparison``.
        """
        found = self.features(comparison)
        pooled = torch.cat([found.mean((2, 3)), found.amax((2, 3))], 1)
        odds: torch.Tensor = self.head(pooled)[:, 0]
        return odds
