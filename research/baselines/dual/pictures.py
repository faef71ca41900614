"""Inputs of the towers: small camera images, LiDAR range images, and both as planes of values near one."""

import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from research.baselines.paper_data.frames import Frames
from research.baselines.paper_data.pairs import Pairs
from service.geometry.camera import PinholeCamera

CAMERA_PLANES, LIDAR_PLANES = 5, 3  # red, green, blue, log depth, measured; log range, measured, intensity
#: Largest distance in images, metres. The panoramas discard ranges beyond it too.
REACH_M = 40.0
#: Elevation above and below the axis that a LiDAR of the view grid sees, degrees.
FIELD_DEG = 15.0
#: Height and width of a whole image, and of one cut to the LiDAR's elevations, pixels.
WHOLE, FIELD = (112, 112), (32, 128)


@dataclass(frozen=True, slots=True)
class Pictures:
    """Images of one camera.

    Attributes:
        rgb: colours (n, h, w, 3), sRGB.
        depth_m: z (n, h, w), metres, 0 for no measurement.
        camera: camera of the images.
    """

    rgb: NDArray[np.uint8]
    depth_m: NDArray[np.float16]
    camera: PinholeCamera

    def planes(self, rows: NDArray[np.int64], rng: np.random.Generator | None = None) -> Tensor:
        """Return planes (B, 5, h, w) of images.

        Args:
            rows: rows of the images (B,).
            rng: source of random brightness and tint of each image, for training; None keeps the colours.
        """
        rgb = torch.from_numpy(self.rgb[rows]).permute(0, 3, 1, 2).float() / 255
        if rng is not None:
            gain = rng.uniform(0.7, 1.3, (len(rows), 1)) * rng.uniform(0.9, 1.1, (len(rows), 3))
            lift = rng.uniform(-0.1, 0.1, (len(rows), 1)) + np.zeros((1, 3))
            rgb = rgb * _of_planes(gain) + _of_planes(lift)
        depth = torch.from_numpy(self.depth_m[rows]).float().unsqueeze(1)
        return torch.cat([(rgb.clamp(0, 1) - 0.45) / 0.25, *_distance(depth)], dim=1)


@dataclass(frozen=True, slots=True)
class Sweeps:
    """Frames of a traversal in memory, with the fields of ``Frames`` of the same names.

    Attributes:
        panoramas: ranges (n, rows, around), metres.
        intensities: intensities (n, rows, around), 255 times the root of 0..1.
        places: x, y, heading and height of each frame (n, 4), metres and radians.
        street: street classes (n,).
    """

    panoramas: NDArray[np.float16]
    intensities: NDArray[np.uint8]
    places: NDArray[np.float64]
    street: NDArray[np.int64]

    @staticmethod
    def of(frames: Frames, rows: NDArray[np.int64]) -> "Sweeps":
        """Read some frames into memory.

        Args:
            frames: LiDAR frames on disk.
            rows: rows to read (n,), in increasing order.
        """
        return Sweeps(
            frames.panoramas[rows], frames.intensities[rows], np.array(frames.places[rows]), frames.street[rows]
        )

    def __len__(self) -> int:
        return len(self.street)


def pictures_of(pairs: Pairs, size: tuple[int, int]) -> Pictures:
    """Return all images of ``pairs``, whole for ``WHOLE`` or cut to the LiDAR's elevations for ``FIELD``; colour is averaged.

    Args:
        pairs: RGB-D pairs.
        size: ``WHOLE`` or ``FIELD``.
    """
    camera, top, bottom = pairs.camera, 0, pairs.camera.height
    if size == FIELD:
        half = camera.fy * math.tan(math.radians(FIELD_DEG))
        top, bottom = max(0, math.ceil(camera.cy - half)), min(camera.height, math.floor(camera.cy + half) + 1)
    cut = PinholeCamera(camera.width, bottom - top, camera.fx, camera.fy, camera.cx, camera.cy - top)
    height, width = size
    rgb = np.empty((len(pairs), height, width, 3), np.uint8)
    depth_m = np.empty((len(pairs), height, width), np.float16)
    for row in range(len(pairs)):
        rgb[row] = cv2.resize(np.asarray(pairs.rgb[row, top:bottom]), (width, height), interpolation=cv2.INTER_AREA)
        nearest = cv2.resize(
            np.asarray(pairs.depth_mm[row, top:bottom]), (width, height), interpolation=cv2.INTER_NEAREST
        )
        depth_m[row] = np.asarray(nearest, np.float32) / 1000
    return Pictures(rgb, depth_m, cut.scaled_to(width, height))


def lidar_planes(distance_m: NDArray[np.float16], intensity: NDArray[np.uint8]) -> Tensor:
    """Return planes (B, 3, h, w) of LiDAR images.

    Args:
        distance_m: distances (B, h, w), metres, 0 for no measurement.
        intensity: intensities (B, h, w), 255 times the root of 0..1.
    """
    bright = torch.from_numpy(np.ascontiguousarray(intensity)).float().unsqueeze(1) / 255
    return torch.cat(
        [*_distance(torch.from_numpy(np.ascontiguousarray(distance_m)).float().unsqueeze(1)), bright], dim=1
    )


def _distance(metres: Tensor) -> tuple[Tensor, Tensor]:
    measured = ((metres > 0) & (metres <= REACH_M)).float()
    return torch.log(metres.clamp(0.5, REACH_M) / 10) * measured, measured


def _of_planes(values: NDArray[np.float64]) -> Tensor:
    return torch.from_numpy(values).float()[:, :, None, None]
