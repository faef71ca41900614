"""Two convolutional towers, one per sensor, that end in unit descriptors of one space."""

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

#: Side of the patches of the first layer, pixels.
PATCH = 4
#: Channels that the last layer reads.
NARROW = 64


class Convolution(nn.Module):
    """A 3 x 3 convolution with batch normalisation.

    Args:
        inputs: input channels.
        outputs: output channels.
        stride: stride along both axes.
        around: whether the last axis is closed, so that its first column borders on the last.
    """

    def __init__(self, inputs: int, outputs: int, stride: int = 1, *, around: bool) -> None:
        super().__init__()
        self.around = around
        self.convolution = nn.Conv2d(inputs, outputs, 3, stride, (1, 0 if around else 1), bias=False)
        self.norm = nn.BatchNorm2d(outputs)

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, inputs, h, w) to (B, outputs, h / stride, w / stride).

        Args:
            x: input (B, inputs, h, w).
        """
        if self.around:
            x = torch.cat([x[..., -1:], x, x[..., :1]], dim=3)
        out: Tensor = self.norm(self.convolution(x))
        return out


class Residual(nn.Module):
    """Two convolutions with a shortcut around both (He et al., CVPR 2016).

    Args:
        channels: input and output channels.
        around: whether the last axis is closed.
    """

    def __init__(self, channels: int, *, around: bool) -> None:
        super().__init__()
        self.first = Convolution(channels, channels, around=around)
        self.second = Convolution(channels, channels, around=around)

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, channels, h, w) to the same shape.

        Args:
            x: input (B, channels, h, w).
        """
        return functional.relu(x + self.second(functional.relu(self.first(x))))


class Tower(nn.Module):
    """Patches, stages of a residual pair at half the size each, and one fully connected layer over all cells.

    The last layer reads positions of cells, not an average. Patches of 4 x 4 pixels replace convolutions at full size,
    which took most of the time on a processor.

    Args:
        inputs: number of planes.
        size: height and width of the planes.
        widths: channels of the patches and of each stage.
        patch_pair: whether the patches get a residual pair too.
        descriptor: size of the descriptor.
        around: whether the images are closed in azimuth; a shift by 4 columns then shifts the patches by one.
    """

    def __init__(
        self,
        inputs: int,
        size: tuple[int, int],
        *,
        widths: tuple[int, ...],
        patch_pair: bool,
        descriptor: int,
        around: bool = False,
    ) -> None:
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
        """Compute unit descriptors (B, D).

        Args:
            planes: input (B, inputs, height, width).
        """
        cells = self.cells(planes.contiguous(memory_format=torch.channels_last))
        return functional.normalize(self.full(cells.flatten(1)), dim=1)


class Towers(nn.Module):
    """The camera tower, the LiDAR tower, and the logarithm of the inverse temperature (Radford et al., ICML 2021).

    Args:
        camera: tower of the camera.
        lidar: tower of the LiDAR.
    """

    def __init__(self, camera: Tower, lidar: Tower) -> None:
        super().__init__()
        self.camera, self.lidar = camera, lidar
        self.log_scale = nn.Parameter(torch.tensor(1 / 0.07).log())
