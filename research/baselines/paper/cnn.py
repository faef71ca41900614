"""The paper's CNN (section 4.II, Figure 9) as a classifier of the 16 classes, and the features for K-NN.

The text of Figure 9 is lost, and the paper names no layer. Our reading of "12 layers" is as follows. The paper divides
the layers of a CNN "into three types: Convolution, Pooling, and Full Connected" (2.II), so we count only these types:
five times convolution and pooling, then two full connections. Filters are 3 x 3 with 8, 16, 32, 64 and 128 channels,
and max pooling halves each side. This follows MATLAB's own example of a network trained by ``sgdm``, because the paper
used MATLAB. The last feature map is 7 x 7. Batch normalisation and ReLU belong to their convolution and are not
counted, as in the paper's own count of types.
"""

import torch
from torch import Tensor, nn

CHANNELS = (8, 16, 32, 64, 128)
FEATURES, CLASSES, SIDE = 128, 16, 224


class PaperCnn(nn.Module):
    """The network: images (B, 3, 224, 224) in 0..1 to class scores (B, 16)."""

    def __init__(self) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        before = 3
        for channels in CHANNELS:
            # Pool first: max pooling commutes with functions that never decrease, and this order is twice as fast.
            layers += [
                nn.Conv2d(before, channels, 3, padding=1, bias=False),
                nn.MaxPool2d(2),
                nn.BatchNorm2d(channels),
                nn.ReLU(inplace=True),
            ]
            before = channels
        self.convolutions = nn.Sequential(*layers)
        side = SIDE // 2 ** len(CHANNELS)
        self.first = nn.Linear(before * side * side, FEATURES)
        self.last = nn.Linear(FEATURES, CLASSES)

    def features(self, pictures: Tensor) -> Tensor:
        """Compute the features for K-NN, the output (B, 128) of the first full connection.

        Args:
            pictures: images (B, 3, 224, 224) in 0..1.
        """
        found: Tensor = torch.relu(self.first(self.convolutions(pictures).flatten(1)))
        return found

    def forward(self, pictures: Tensor) -> Tensor:
        """Compute class scores (B, 16) before the softmax.

        Args:
            pictures: images (B, 3, 224, 224) in 0..1.
        """
        scores: Tensor = self.last(self.features(pictures))
        return scores


def layer_table() -> list[tuple[str, str, str]]:
    """Return number and kind, function, and output of each layer, as a counterpart of Figure 9."""
    rows, side = [("", "input", f"{SIDE} x {SIDE} x 3")], SIDE
    for k, channels in enumerate(CHANNELS):
        rows.append((f"{2 * k + 1} convolution", f"{channels} filters 3 x 3", f"{side} x {side} x {channels}"))
        side //= 2
        rows.append(
            (f"{2 * k + 2} pooling", "maximum of 2 x 2, batch normalisation, ReLU", f"{side} x {side} x {channels}")
        )
    rows.append(("11 fully connected", f"{FEATURES} features, the descriptor of K-NN", str(FEATURES)))
    rows.append(("12 fully connected", "softmax of the 16 classes", str(CLASSES)))
    return [(number, does, out) for number, does, out in rows]
