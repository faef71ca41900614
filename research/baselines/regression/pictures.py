"""RGB-D pairs as inputs of GoogLeNet, and the held-out pairs of a training."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from research.baselines.paper_data.pairs import Pairs
from research.baselines.regression.googlenet import PLANES, Pose
from service.errors import DatasetError
from service.geometry.rigid import quaternion_xyzw_from, rotation_from_quaternion_xyzw, transform_from

#: Mean and scale of sRGB in 0..1 for the normalisation.
GREY, SPREAD = 0.45, 0.25
DEPTH_UNIT_M = 20.0
WATCHED_SHARE, BLOCK_M = 0.05, 10.0


@dataclass(frozen=True, slots=True)
class Jitter:
    """Random changes of a training image, as shares. There are no flips: a mirrored street is another place.

    Attributes:
        gain: standard deviation of the log gain of all colours.
        tint: standard deviation of the log gain of each colour.
        offset: largest offset of the colours, of full scale.
        depth_gain: standard deviation of the log gain of depth.
        depth_lost: share of images that lose depth in a rectangle.
        lost_side: largest side of that rectangle, as a share of the image's side.
    """

    gain: float = 0.25
    tint: float = 0.08
    offset: float = 0.1
    depth_gain: float = 0.02
    depth_lost: float = 0.5
    lost_side: float = 0.5


@dataclass(frozen=True, slots=True)
class MapFrame:
    """Normalised map coordinates, with the same scale along all axes.

    Attributes:
        centre_m: origin, metres, map frame.
        scale_m: unit of length, metres.
    """

    centre_m: tuple[float, float, float]
    scale_m: float

    @staticmethod
    def of(xyz: NDArray[np.float64]) -> "MapFrame":
        """Centre on the mean of positions; the unit is their standard deviation along the wider of x and y.

        Args:
            xyz: positions (n, 3), metres, map frame.
        """
        x, y, z = xyz.mean(axis=0)
        return MapFrame((float(x), float(y), float(z)), max(float(xyz[:, :2].std(axis=0).max()), 1.0))

    def normalised(self, xyz: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert metres to normalised coordinates (n, 3).

        Args:
            xyz: positions (n, 3), metres, map frame.
        """
        return np.asarray((xyz - np.array(self.centre_m)) / self.scale_m)

    def metres(self, normalised: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert normalised coordinates to metres (n, 3).

        Args:
            normalised: positions (n, 3), normalised.
        """
        return np.asarray(normalised * self.scale_m + np.array(self.centre_m))


def watched_rows(pairs: Pairs) -> NDArray[np.bool_]:
    """Return which pairs (n,) are held out: a twentieth of all, in whole 10 m squares of ground over both traversals.

    The rows of a query set are not in the order of the traversal. Blocks of rows would therefore not be separate
    places.

    Args:
        pairs: RGB-D pairs.

    Raises:
        DatasetError: all pairs are in one square.
    """
    cell = np.floor(pairs.T_map_camera[:, :2, 3] / BLOCK_M).astype(np.int64)
    _, block, sizes = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
    order = np.random.default_rng(17).permutation(len(sizes))
    before = np.cumsum(sizes[order]) - sizes[order]
    kept_back: NDArray[np.bool_] = np.isin(block.reshape(-1), order[before < WATCHED_SHARE * len(pairs)])
    if kept_back.all():
        raise DatasetError("the pairs are too close together to hold out some; use a longer drive", field="pairs")
    return kept_back


def planes_of(
    pairs: Pairs,
    rows: NDArray[np.int64],
    side: int,
    *,
    jitter: Jitter | None = None,
    rng: np.random.Generator | None = None,
) -> Tensor:
    """Return images (B, 4, side, side), with random changes if both ``jitter`` and ``rng`` are given.

    Colours are averaged over the pixels that become one, then normalised. Depth is that of the nearest pixel, in units
    of 20 m, 0 for no measurement.

    Args:
        pairs: RGB-D pairs.
        rows: rows of the pairs (B,).
        side: side of the images, pixels.
        jitter: random changes; None for none.
        rng: source of randomness; None for no changes.
    """
    found = np.empty((len(rows), PLANES, side, side), np.float32)
    for picture, row in zip(found, rows, strict=True):
        rgb = np.asarray(cv2.resize(pairs.rgb[row], (side, side), interpolation=cv2.INTER_AREA), np.float32)
        depth = np.asarray(cv2.resize(pairs.depth_mm[row], (side, side), interpolation=cv2.INTER_NEAREST), np.float32)
        picture[:3] = rgb.transpose(2, 0, 1) / 255.0
        picture[3] = depth / (1000.0 * DEPTH_UNIT_M)
        if jitter is not None and rng is not None:
            _jitter(picture, jitter, rng)
    found[:, :3] = (found[:, :3] - GREY) / SPREAD
    return torch.from_numpy(found)


def _jitter(picture: NDArray[np.float32], jitter: Jitter, rng: np.random.Generator) -> None:
    """Change an image in place: exposure, white balance and offset of the colours; scale of the depth, and a hole in it."""
    gains = np.exp(rng.normal(0, jitter.gain) + rng.normal(0, jitter.tint, 3))
    picture[:3] = np.clip(picture[:3] * gains[:, None, None] + rng.uniform(-jitter.offset, jitter.offset), 0, 1)
    picture[3] *= np.float32(np.exp(rng.normal(0, jitter.depth_gain)))
    if rng.random() < jitter.depth_lost:
        side = picture.shape[1]
        height, width = (int(side * rng.uniform(0.0, jitter.lost_side)) for _ in range(2))
        top, left = int(rng.integers(side - height)), int(rng.integers(side - width))
        picture[3, top : top + height, left : left + width] = 0.0


def poses_of(T_map_camera: NDArray[np.float64], frame: MapFrame) -> Pose:
    """Convert transforms to the network's target poses.

    Args:
        T_map_camera: transforms (n, 4, 4).
        frame: normalised map coordinates.
    """
    position = frame.normalised(T_map_camera[:, :3, 3])
    quaternion = np.array([quaternion_xyzw_from(T[:3, :3]) for T in T_map_camera]).reshape(-1, 4)
    return Pose(torch.from_numpy(position.astype(np.float32)), torch.from_numpy(quaternion.astype(np.float32)))


def transforms_of(pose: Pose, frame: MapFrame) -> NDArray[np.float64]:
    """Convert a network's poses to T_map_camera (n, 4, 4).

    Args:
        pose: output of the network.
        frame: normalised map coordinates.
    """
    positions = frame.metres(pose.position.double().numpy())
    rotations = [rotation_from_quaternion_xyzw(q) for q in pose.quaternion.double().numpy()]
    both = [transform_from(R, xyz) for R, xyz in zip(rotations, positions, strict=True)]
    return np.array(both).reshape(-1, 4, 4)
