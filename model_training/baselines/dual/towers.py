"""Two convolutional towers, one for each sensor, that end in unit descriptors of one space."""

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

PATCH = 4  # pixels a side that the first layer takes together
NARROW = 64  # channels that the last layer reads


class Convolution(nn.Module):
    """3 x 3, batch norm; ``around``: the last axis is closed, its first column borders on the last."""

    def __init__(self, inputs: int, outputs: int, stride: int = 1, *, around: bool) -> None:
        super().__init__()
        self.around = around
        self.convolution = nn.Conv2d(inputs, outputs, 3, stride, (1, 0 if around else 1), bias=False)
        self.norm = nn.BatchNorm2d(outputs)

    def forward(self, x: Tensor) -> Tensor:
        """(B, inputs, h, w) to (B, outputs, h / stride, w / stride)."""
        if self.around:
            x = torch.cat([x[..., -1:], x, x[..., :1]], dim=3)
        out: Tensor = self.norm(self.convolution(x))
        return out


class Residual(nn.Module):
    """Two convolutions with a shortcut round both (He et al., CVPR 2016)."""

    def __init__(self, channels: int, *, around: bool) -> None:
        super().__init__()
        self.first = Convolution(channels, channels, around=around)
        self.second = Convolution(channels, channels, around=around)

    def forward(self, x: Tensor) -> Tensor:
        """(B, channels, h, w), the same shape."""
        return functional.relu(x + self.second(functional.relu(self.first(x))))


class Tower(nn.Module):
    """Patches, stages of a residual pair at half the size each, and one fully connected layer over all cells.

    The last layer reads where things are, not an average. Patches of 4 x 4 pixels instead of convolutions at full size: on a
    processor those took most of the time.

    Args:
        inputs: planes.
        size: (height, width) of them.
        widths: channels of the patches and of each stage.
        patch_pair: a residual pair on the patches, too.
        descriptor: size of the descriptor.
        around: the pictures are closed in azimuth; shifting them by 4 columns then shifts the patches by one.
    """

    def __init__(
        self, inputs: int, size: tuple[int, int], *, widths: tuple[int, ...], patch_pair: bool, descriptor: int,
        around: bool = False,
    ) -> None:  # fmt: skip
        super().__init__()
        layers: list[nn.Module] = [
            nn.Conv2d(inputs, widths[0], PATCH, PATCH, bias=False),
            nn.BatchNorm2d(widths[0]),
            nn.ReLU(),
        ]
        if patch_pair:
            layers.append(Residual(widths[0], around=around))
        height, width = size[0] // PATCH, size[1] // PATCH
        for before, channels in pairwise(widths):
            layers += [Convolution(before, channels, 2, around=around), nn.ReLU(), Residual(channels, around=around)]
            height, width = -(-height // 2), -(-width // 2)
        self.cells = nn.Sequential(*layers, nn.Conv2d(widths[-1], NARROW, 1), nn.ReLU())
        self.full = nn.Linear(NARROW * height * width, descriptor)

    def forward(self, planes: Tensor) -> Tensor:
        """Unit descriptors (B, D) of planes (B, inputs, height, width)."""
        cells = self.cells(planes.contiguous(memory_format=torch.channels_last))
        return functional.normalize(self.full(cells.flatten(1)), dim=1)


class Towers(nn.Module):
    """The camera's tower, the LiDAR's, and the logarithm of the inverse temperature (Radford et al., ICML 2021)."""

    def __init__(self, camera: Tower, lidar: Tower) -> None:
        super().__init__()
        self.camera, self.lidar = camera, lidar
        self.log_scale = nn.Parameter(torch.tensor(1 / 0.07).log())
