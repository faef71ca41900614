"""Inputs of the paper's CNN: images of LiDAR frames and of fused RGB-D pairs, in two image spaces.

*From above* is the paper's space: a whole LiDAR frame as a 2.5D image. The paper compares it with the fused image in
the camera's view. *One space* is what the paper would need: both on the levelled view grid (azimuth x elevation), with
range in the place of intensity, enlarged to the network's 224 x 224. A LiDAR has no colour, so its images are grey.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from research.baselines.paper.cnn import SIDE
from research.baselines.paper_data.frames import Frames
from research.baselines.paper_data.pairs import Pairs
from service.imaging.fusion import fuse, picture_of
from service.imaging.view_grid import ViewGrid

Space = Literal["aligned", "plain", "view"]
Pictures = NDArray[np.uint8]  # (B, 224, 224, 3)
Rows = NDArray[np.int64]
#: Largest turn of a training view against the street, either way along it, radians. The queries have the same range.
TURN_RAD = np.deg2rad(15.0)
_GRID = ViewGrid()


@dataclass(frozen=True)
class LidarPictures:
    """Images of LiDAR frames.

    Attributes:
        frames: LiDAR frames.
        space: ``aligned`` by PCA or ``plain`` from above, or ``view`` along a heading.
    """

    frames: Frames
    space: Space

    def of(self, rows: Rows, headings_rad: NDArray[np.float64] | None = None) -> Pictures:
        """Return the images of frames (B, 224, 224, 3).

        Args:
            rows: rows of the frames (B,).
            headings_rad: headings of views (B,) against the vehicle's, radians; None for 0.
        """
        if self.space == "view":
            turned = np.zeros(len(rows)) if headings_rad is None else headings_rad
            return drawn_views(turned_views((self.frames.panoramas[row] for row in rows), turned), None)
        grey = getattr(self.frames, self.space)[rows]
        return np.repeat(grey[..., None], 3, axis=3)

    def shaken(self, rows: Rows, rng: np.random.Generator) -> Pictures:
        """Return training images (B, 224, 224, 3): views look either way along the street with a small turn; others are unchanged.

        Args:
            rows: rows of the frames (B,).
            rng: source of randomness.
        """
        turn = rng.uniform(-TURN_RAD, TURN_RAD, len(rows)) + np.pi * rng.integers(0, 2, len(rows))
        return self.of(rows, turn)


def turned_views(panoramas: Iterable[NDArray[np.floating]], headings_rad: NDArray[np.float64]) -> NDArray[np.floating]:
    """Return the views of panoramas (B, rows, columns) along headings.

    Args:
        panoramas: B panoramas (rows, around); column 0 is at azimuth -pi.
        headings_rad: headings (B,), radians, against azimuth 0 of the panorama.
    """
    columns = (headings_rad[:, None] + _GRID.azimuths_rad + np.pi) / (2 * np.pi) * _GRID.around
    which = np.rint(columns).astype(np.int64) % _GRID.around
    return np.stack([each[:, at] for each, at in zip(panoramas, which, strict=True)])


def fused_pictures(pairs: Pairs, rows: Rows, space: Space, *, colour: bool = True) -> Pictures:
    """Return images of RGB-D pairs (B, 224, 224, 3), fused by IHS in the camera's view, or on the view grid for ``view``.

    Args:
        pairs: RGB-D pairs.
        rows: rows of the pairs (B,).
        space: image space.
        colour: whether to use colour; otherwise depth alone in grey.
    """
    if space == "view":
        return drawn_views(pairs.ranges[rows], pairs.colours[rows] if colour else None)
    found = []
    for row in rows:
        rgb = np.asarray(pairs.rgb[row])
        depth_m = pairs.depth_mm[row].astype(np.float32) / 1000
        planes = fuse(rgb if colour else np.zeros_like(rgb), depth_m).planes
        found.append(picture_of(planes, _GRID.max_range_m))
    return np.stack(found)


def drawn_views(ranges: NDArray[np.floating], colours: NDArray[np.uint8] | None) -> Pictures:
    """Return views as images of the network's size (B, 224, 224, 3).

    Args:
        ranges: ranges on the view grid (B, rows, columns), metres.
        colours: colours (B, rows, columns, 3); None for grey.
    """
    found = np.zeros((len(ranges), SIDE, SIDE, 3), np.uint8)
    for k, each in enumerate(ranges):
        metres = np.asarray(each, np.float32)
        metres[metres > _GRID.max_range_m] = 0
        rgb = np.zeros((*metres.shape, 3), np.uint8) if colours is None else colours[k]
        small = picture_of(fuse(rgb, metres).planes, _GRID.max_range_m)
        found[k] = cv2.resize(small, (SIDE, SIDE), interpolation=cv2.INTER_NEAREST)
    return found
