"""GoogLeNet that regresses a camera's pose from an RGB-D image.

The network is that of Szegedy et al. (CVPR 2015) with batch normalisation (Ioffe and Szegedy, 2015). Its first layer
takes four planes, and its three classifiers are regressors, as in PoseNet (Kendall et al., ICCV 2015). All pools before
the heads adapt to the size of the image, so any side from 32 pixels works. At 224 the cells are the published ones.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from model_training.training.precision import forward_in

PLANES = 4  # red, green, blue, depth
#: Cells per side of the feature map that an auxiliary head reads.
AUXILIARY_CELLS = 4


class Pose(NamedTuple):
    """Poses T_map_camera.

    Attributes:
        position: normalised map coordinates (B, 3).
        quaternion: unit quaternions x, y, z, w (B, 4).
    """

    position: Tensor
    quaternion: Tensor


def convolution(inputs: int, outputs: int, size: int = 1, *, stride: int = 1) -> nn.Sequential:
    """Make a convolution that keeps the image's size except for its stride, with batch normalisation and ReLU.

    Args:
        inputs: input channels.
        outputs: output channels.
        size: side of the kernel.
        stride: stride along both axes.
    """
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, size, stride, size // 2, bias=False), nn.BatchNorm2d(outputs), nn.ReLU(inplace=True)
    )


class Inception(nn.Module):
    """Four parallel branches: 1 x 1, 3 x 3, 5 x 5 and a pool; a 1 x 1 convolution narrows the last three.

    Args:
        inputs: input channels.
        widths: a row of the publication's table 1: #1x1, #3x3 reduce, #3x3, #5x5 reduce, #5x5, pool proj.
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
        """Map (B, inputs, h, w) to (B, outputs, h, w).

        Args:
            planes: input (B, inputs, h, w).
        """
        return torch.cat([self.one(planes), self.three(planes), self.five(planes), self.pooled(planes)], dim=1)


class PoseHead(nn.Module):
    """A hidden layer, then position and quaternion.

    Args:
        inputs: size of the features.
        hidden: size of the hidden layer.
        dropout: share of hidden units to drop.
    """

    def __init__(self, inputs: int, hidden: int, dropout: float) -> None:
        super().__init__()
        self.hidden = nn.Sequential(nn.Linear(inputs, hidden), nn.ReLU(inplace=True), nn.Dropout(dropout))
        self.position, self.quaternion = nn.Linear(hidden, 3), nn.Linear(hidden, 4)

    def forward(self, features: Tensor) -> Pose:
        """Map features to poses.

        Args:
            features: features (B, inputs).
        """
        hidden = self.hidden(features).float()
        with forward_in("float32"):  # eight bits would resolve a city's width only to a metre
            return Pose(self.position(hidden), functional.normalize(self.quaternion(hidden), dim=1))


class AuxiliaryHead(nn.Module):
    """Pose from the middle of the network: a pool, a 1 x 1 convolution to 128 planes, and 1,024 hidden units.

    Args:
        inputs: input channels.
        dropout: share of hidden units to drop.
    """

    def __init__(self, inputs: int, dropout: float) -> None:
        super().__init__()
        self.narrow = convolution(inputs, 128)
        self.head = PoseHead(128 * AUXILIARY_CELLS**2, 1024, dropout)

    def forward(self, planes: Tensor) -> Pose:
        """Map feature maps to poses.

        Args:
            planes: feature maps (B, inputs, h, w).
        """
        cells = functional.adaptive_avg_pool2d(planes, AUXILIARY_CELLS)
        found: Pose = self.head(self.narrow(cells).flatten(1))
        return found


class GoogLeNet(nn.Module):
    """The network from RGB-D images to poses.

    Args:
        dropout: share of units dropped before the outputs of every head (published: 0.4, and 0.7 for the auxiliary
            heads, with 1.2 million images).
    """

    def __init__(self, *, dropout: float = 0.0) -> None:
        super().__init__()
        self.stem = nn.Sequential(
            convolution(PLANES, 64, 7, stride=2), _halved(), convolution(64, 64), convolution(64, 192, 3), _halved()
        )
        self.until_4a = nn.Sequential(
            Inception(192, (64, 96, 128, 16, 32, 32)),
            Inception(256, (128, 128, 192, 32, 96, 64)),
            _halved(),
            Inception(480, (192, 96, 208, 16, 48, 64)),
        )
        self.until_4d = nn.Sequential(
            Inception(512, (160, 112, 224, 24, 64, 64)),
            Inception(512, (128, 128, 256, 24, 64, 64)),
            Inception(512, (112, 144, 288, 32, 64, 64)),
        )
        self.until_5b = nn.Sequential(
            Inception(528, (256, 160, 320, 32, 128, 128)),
            _halved(),
            Inception(832, (256, 160, 320, 32, 128, 128)),
            Inception(832, (384, 192, 384, 48, 128, 128)),
        )
        self.head = PoseHead(1024, 2048, dropout)
        self.auxiliary = nn.ModuleList([AuxiliaryHead(512, dropout), AuxiliaryHead(528, dropout)])

    def forward(self, planes: Tensor) -> list[Pose]:
        """Return the poses of the last head and, in training, of the two auxiliary heads.

        Args:
            planes: images (B, 4, side, side).
        """
        at_4a = self.until_4a(self.stem(planes))
        at_4d = self.until_4d(at_4a)
        last = functional.adaptive_avg_pool2d(self.until_5b(at_4d), 1).flatten(1)
        poses: list[Pose] = [self.head(last)]
        if self.training:
            poses += [head(each) for head, each in zip(self.auxiliary, (at_4a, at_4d), strict=True)]
        return poses


def _halved() -> nn.MaxPool2d:
    return nn.MaxPool2d(3, 2, 1)
