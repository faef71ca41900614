"""PointNet's global feature of a cloud (Qi et al., CVPR 2017), without the T-nets, as PointNetLK has it."""

import torch
from torch import Tensor, nn

WIDTHS = (64, 64, 64, 128, 512)


class PointNet(nn.Module):
    """The same layers for every point, then the largest value of each feature over the cloud.

    Published with 1,024 features and batch normalisation; ours has 512, for twice the clouds in the same budget, and none: Lucas
    and Kanade compare two passes, and statistics that differ between them are a motion that is not there.
    """

    def __init__(self, widths: tuple[int, ...] = WIDTHS) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for inputs, outputs in zip((3, *widths[:-1]), widths, strict=True):
            layer = nn.Linear(inputs, outputs)
            nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
            nn.init.uniform_(layer.bias, -0.1, 0.1)
            layers += [layer, nn.ReLU(inplace=True)]
        self.layers = nn.Sequential(*layers)

    def forward(self, points: Tensor) -> Tensor:
        """Clouds (B, N, 3) of a size near 1 to features (B, F); the order of the points does not matter."""
        largest: Tensor = torch.amax(self.layers(points), dim=1)
        return largest
