"""GoogLeNet that regresses a camera's pose from an RGB-D picture.

The network is that of Szegedy et al. (CVPR 2015) with batch normalisation (Ioffe and Szegedy, 2015), its first layer for four
planes and its three classifiers made regressors, as PoseNet did (Kendall et al., ICCV 2015). All pools before the heads adapt
to the size of the picture, so that any side from 32 pixels works; at 224 the cells are those published.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from model_training.training.precision import forward_in

PLANES = 4  # red, green, blue, depth
AUXILIARY_CELLS = 4  # a side; what an auxiliary head sees of the picture


class Pose(NamedTuple):
    """``position`` (B, 3), normalised map coordinates; ``quaternion`` (B, 4), unit, x, y, z, w; T_map_camera's."""

    position: Tensor
    quaternion: Tensor


def convolution(inputs: int, outputs: int, size: int = 1, *, stride: int = 1) -> nn.Sequential:
    """A convolution that keeps the picture's size but for its stride, batch normalisation, ReLU."""
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, size, stride, size // 2, bias=False), nn.BatchNorm2d(outputs), nn.ReLU(inplace=True)
    )


class Inception(nn.Module):
    """Four branches side by side: 1 x 1, 3 x 3, 5 x 5 and a pool, the last three narrowed by a 1 x 1 convolution.

    Args:
        inputs: planes.
        widths: a row of the paper's table 1: #1x1, #3x3 reduce, #3x3, #5x5 reduce, #5x5, pool proj.
    """

    def __init__(self, inputs: int, widths: tuple[int, int, int, int, int, int]) -> None:
        super().__init__()
        one, narrow_three, three, narrow_five, five, pooled = widths
        self.outputs = one + three + five + pooled
        self.one = convolution(inputs, one)
        self.three = nn.Sequential(convolution(inputs, narrow_three), convolution(narrow_three, three, 3))
        self.five = nn.Sequential(convolution(inputs, narrow_five), convolution(narrow_five, five, 5))
        self.pooled = nn.Sequential(nn.MaxPool2d(3, 1, 1), convolution(inputs, pooled))

    def forward(self, planes: Tensor) -> Tensor:
        """(B, inputs, h, w) to (B, outputs, h, w)."""
        return torch.cat([self.one(planes), self.three(planes), self.five(planes), self.pooled(planes)], dim=1)


class PoseHead(nn.Module):
    """A hidden layer, then position and quaternion."""

    def __init__(self, inputs: int, hidden: int, dropout: float) -> None:
        super().__init__()
        self.hidden = nn.Sequential(nn.Linear(inputs, hidden), nn.ReLU(inplace=True), nn.Dropout(dropout))
        self.position, self.quaternion = nn.Linear(hidden, 3), nn.Linear(hidden, 4)

    def forward(self, features: Tensor) -> Pose:
        """(B, inputs) to a pose."""
        hidden = self.hidden(features).float()
        with forward_in("float32"):  # eight bits would tell a city's width in steps of a metre
            return Pose(self.position(hidden), functional.normalize(self.quaternion(hidden), dim=1))


class AuxiliaryHead(nn.Module):
    """A pose from the middle of the network: pool, 1 x 1 convolution to 128 planes, 1,024 hidden units."""

    def __init__(self, inputs: int, dropout: float) -> None:
        super().__init__()
        self.narrow = convolution(inputs, 128)
        self.head = PoseHead(128 * AUXILIARY_CELLS**2, 1024, dropout)

    def forward(self, planes: Tensor) -> Pose:
        """(B, inputs, h, w) to a pose."""
        cells = functional.adaptive_avg_pool2d(planes, AUXILIARY_CELLS)
        found: Pose = self.head(self.narrow(cells).flatten(1))
        return found


class GoogLeNet(nn.Module):
    """RGB-D pictures to poses.

    Args:
        dropout: before the outputs of every head (published: 0.4, and 0.7 for the auxiliary ones, for 1.2 million pictures).
    """

    def __init__(self, *, dropout: float = 0.0) -> None:
        super().__init__()
        self.stem = nn.Sequential(
            convolution(PLANES, 64, 7, stride=2), _halved(), convolution(64, 64), convolution(64, 192, 3), _halved()
        )
        self.until_4a = nn.Sequential(
            Inception(192, (64, 96, 128, 16, 32, 32)), Inception(256, (128, 128, 192, 32, 96, 64)), _halved(),
            Inception(480, (192, 96, 208, 16, 48, 64)),
        )  # fmt: skip
        self.until_4d = nn.Sequential(
            Inception(512, (160, 112, 224, 24, 64, 64)), Inception(512, (128, 128, 256, 24, 64, 64)),
            Inception(512, (112, 144, 288, 32, 64, 64)),
        )  # fmt: skip
        self.until_5b = nn.Sequential(
            Inception(528, (256, 160, 320, 32, 128, 128)), _halved(), Inception(832, (256, 160, 320, 32, 128, 128)),
            Inception(832, (384, 192, 384, 48, 128, 128)),
        )  # fmt: skip
        self.head = PoseHead(1024, 2048, dropout)
        self.auxiliary = nn.ModuleList([AuxiliaryHead(512, dropout), AuxiliaryHead(528, dropout)])

    def forward(self, planes: Tensor) -> list[Pose]:
        """Pictures (B, 4, side, side) to the poses of the last head and, while training, of the two auxiliary ones."""
        at_4a = self.until_4a(self.stem(planes))
        at_4d = self.until_4d(at_4a)
        last = functional.adaptive_avg_pool2d(self.until_5b(at_4d), 1).flatten(1)
        poses: list[Pose] = [self.head(last)]
        if self.training:
            poses += [head(each) for head, each in zip(self.auxiliary, (at_4a, at_4d), strict=True)]
        return poses


def _halved() -> nn.MaxPool2d:
    return nn.MaxPool2d(3, 2, 1)
