"""PointNet's global feature of a cloud (Qi et al., CVPR 2017) without the T-nets, as in PointNetLK."""

import torch
from torch import Tensor, nn

WIDTHS = (64, 64, 64, 128, 512)


class PointNet(nn.Module):
    """The same layers for every point, then the maximum of each feature over the cloud.

    The published network has 1,024 features and batch normalisation. Ours has 512 features, for twice the clouds in the
    same budget, and no normalisation. Lucas and Kanade compare two passes, and different statistics of the passes would
    look like a motion.

    Args:
        widths: sizes of the layers.
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
        """Compute features (B, F); the order of the points does not matter.

        Args:
            points: clouds (B, N, 3) of a size near 1.
        """
        largest: Tensor = torch.amax(self.layers(points), dim=1)
        return largest
