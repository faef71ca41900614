"""RGB-D pairs as GoogLeNet takes them, and the pairs that are kept back to watch a training."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from model_training.baselines.paper_data.pairs import Pairs
from model_training.baselines.regression.googlenet import PLANES, Pose
from service.errors import DatasetError
from service.geometry.rigid import quaternion_xyzw_from, rotation_from_quaternion_xyzw, transform_from

GREY, SPREAD = 0.45, 0.25  # of sRGB in 0..1, subtracted and divided by
DEPTH_UNIT_M = 20.0
WATCHED_SHARE, BLOCK_M = 0.05, 10.0


@dataclass(frozen=True, slots=True)
class Jitter:
    """What a training picture may look like; shares. No flips: a mirrored street is another place."""

    gain: float = 0.25  # of all colours
    tint: float = 0.08  # of each colour
    offset: float = 0.1  # of full scale
    depth_gain: float = 0.02
    depth_lost: float = 0.5  # of the pictures lose depth in a rectangle of up to so large a share of each side:
    lost_side: float = 0.5


@dataclass(frozen=True, slots=True)
class MapFrame:
    """Normalised map coordinates: metres about ``centre_m``, divided by ``scale_m``, the same along all axes."""

    centre_m: tuple[float, float, float]
    scale_m: float

    @staticmethod
    def of(xyz: NDArray[np.float64]) -> "MapFrame":
        """About the mean of positions (n, 3), in units of their standard deviation along the wider of x and y."""
        x, y, z = xyz.mean(axis=0)
        return MapFrame((float(x), float(y), float(z)), max(float(xyz[:, :2].std(axis=0).max()), 1.0))

    def normalised(self, xyz: NDArray[np.float64]) -> NDArray[np.float64]:
        """Metres (n, 3) to normalised."""
        return np.asarray((xyz - np.array(self.centre_m)) / self.scale_m)

    def metres(self, normalised: NDArray[np.float64]) -> NDArray[np.float64]:
        """Normalised (n, 3) to metres."""
        return np.asarray(normalised * self.scale_m + np.array(self.centre_m))


def watched_rows(pairs: Pairs) -> NDArray[np.bool_]:
    """A flag for each pair: kept back, a twentieth of all, in whole squares of 10 m of ground (pairs of both drives).

    The rows of a query set are in no order along the drive, so blocks of rows would be no places of their own.

    Raises:
        DatasetError: all stand in one square.
    """
    cell = np.floor(pairs.T_map_camera[:, :2, 3] / BLOCK_M).astype(np.int64)
    _, block, sizes = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
    order = np.random.default_rng(17).permutation(len(sizes))
    before = np.cumsum(sizes[order]) - sizes[order]
    kept_back: NDArray[np.bool_] = np.isin(block.reshape(-1), order[before < WATCHED_SHARE * len(pairs)])
    if kept_back.all():
        raise DatasetError(
            "the pairs stand too near to each other to keep some back; take more of a drive", field="pairs"
        )
    return kept_back


def planes_of(
    pairs: Pairs, rows: NDArray[np.int64], side: int, *, jitter: Jitter | None = None, rng: np.random.Generator | None = None
) -> Tensor:  # fmt: skip
    """Pictures (B, 4, side, side) of some rows, jittered where both ``jitter`` and ``rng`` are given.

    Normalised colours are averaged over the pixels that become one; depth is that of the nearest pixel, in units of 20 m, 0 where
    nothing was measured.
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
    """In place: exposure, white balance and offset of the colours; scale of the depth, and a hole in it."""
    gains = np.exp(rng.normal(0, jitter.gain) + rng.normal(0, jitter.tint, 3))
    picture[:3] = np.clip(picture[:3] * gains[:, None, None] + rng.uniform(-jitter.offset, jitter.offset), 0, 1)
    picture[3] *= np.float32(np.exp(rng.normal(0, jitter.depth_gain)))
    if rng.random() < jitter.depth_lost:
        side = picture.shape[1]
        height, width = (int(side * rng.uniform(0.0, jitter.lost_side)) for _ in range(2))
        top, left = int(rng.integers(side - height)), int(rng.integers(side - width))
        picture[3, top : top + height, left : left + width] = 0.0


def poses_of(T_map_camera: NDArray[np.float64], frame: MapFrame) -> Pose:
    """What a network is to answer for transforms (n, 4, 4)."""
    position = frame.normalised(T_map_camera[:, :3, 3])
    quaternion = np.array([quaternion_xyzw_from(T[:3, :3]) for T in T_map_camera]).reshape(-1, 4)
    return Pose(torch.from_numpy(position.astype(np.float32)), torch.from_numpy(quaternion.astype(np.float32)))


def transforms_of(pose: Pose, frame: MapFrame) -> NDArray[np.float64]:
    """T_map_camera (n, 4, 4) of what a network answered."""
    positions = frame.metres(pose.position.double().numpy())
    rotations = [rotation_from_quaternion_xyzw(q) for q in pose.quaternion.double().numpy()]
    both = [transform_from(R, xyz) for R, xyz in zip(rotations, positions, strict=True)]
    return np.array(both).reshape(-1, 4, 4)
