"""What the paper's CNN is shown: pictures of LiDAR frames and of fused RGB-D pairs, in two image spaces.

*From above* is the paper's: a whole LiDAR frame as a 2.5D image, against which it holds the fused picture as the camera sees it.
*One space* is what the paper would need: both on the view grid (azimuth x elevation, levelled), range in the place of intensity,
enlarged to the network's 224 x 224. A LiDAR has no colour, so its pictures are grey.
"""

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from model_training.baselines.paper.cnn import SIDE
from model_training.baselines.paper_data.frames import Frames
from model_training.baselines.paper_data.pairs import Pairs
from service.imaging.fusion import fuse, fuse_planes, picture_of
from service.imaging.view_grid import ViewGrid

Space = Literal["aligned", "plain", "view"]
Pictures = NDArray[np.uint8]  # (B, 224, 224, 3)
Rows = NDArray[np.int64]
TURN_RAD = np.deg2rad(15.0)  # of a training view against the street, either way along it: as queries are
_GRID = ViewGrid()


@dataclass(frozen=True)
class LidarPictures:
    """Pictures of LiDAR frames: ``aligned`` by PCA and ``plain`` from above, or cut along a heading (``view``)."""

    frames: Frames
    space: Space

    def of(self, rows: Rows, headings_rad: NDArray[np.float64] | None = None) -> Pictures:
        """Pictures of frames (B); ``headings_rad`` (B), against the vehicle's own, for views; 0 by default."""
        if self.space == "view":
            turned = np.zeros(len(rows)) if headings_rad is None else headings_rad
            columns = (turned[:, None] + _GRID.azimuths_rad + np.pi) / (2 * np.pi) * _GRID.around
            which = np.rint(columns).astype(np.int64) % _GRID.around
            ranges = np.stack([self.frames.panoramas[row][:, at] for row, at in zip(rows, which, strict=True)])
            return drawn_views(ranges, None)
        grey = getattr(self.frames, self.space)[rows]
        return np.repeat(grey[..., None], 3, axis=3)

    def shaken(self, rows: Rows, rng: np.random.Generator) -> Pictures:
        """Pictures to learn from: views look either way along the street, turned a little; others are as they are."""
        turn = rng.uniform(-TURN_RAD, TURN_RAD, len(rows)) + np.pi * rng.integers(0, 2, len(rows))
        return self.of(rows, turn)


def fused_pictures(pairs: Pairs, rows: Rows, space: Space, *, colour: bool = True) -> Pictures:
    """Pictures of RGB-D pairs (B): fused by IHS as the camera sees them, or on the view grid for ``view``.

    Without ``colour`` depth alone is drawn, in grey.
    """
    if space == "view":
        return drawn_views(pairs.ranges[rows], pairs.colours[rows] if colour else None)
    found = []
    for row in rows:
        rgb = np.asarray(pairs.rgb[row])
        depth_m = pairs.depth_mm[row].astype(np.float32) / 1000
        found.append(picture_of(fuse(rgb if colour else np.zeros_like(rgb), depth_m), _GRID.max_range_m))
    return np.stack(found)


def drawn_views(ranges: NDArray[np.floating], colours: NDArray[np.uint8] | None) -> Pictures:
    """Views on the grid (B, rows, columns), metres, and their colours, as pictures of the network's size."""
    found = np.zeros((len(ranges), SIDE, SIDE, 3), np.uint8)
    for k, each in enumerate(ranges):
        metres = np.asarray(each, np.float32)
        metres[metres > _GRID.max_range_m] = 0
        rgb = np.zeros((*metres.shape, 3), np.float32) if colours is None else colours[k].astype(np.float32)
        small = picture_of(fuse_planes(rgb, metres), _GRID.max_range_m)
        found[k] = cv2.resize(small, (SIDE, SIDE), interpolation=cv2.INTER_NEAREST)
    return found
