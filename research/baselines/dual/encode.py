"""Descriptors of images and of the views of places, by trained towers."""

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray

from research.baselines.dual.lidar_views import LidarViews, fan
from research.baselines.dual.pictures import Pictures, Sweeps
from research.baselines.dual.towers import Towers

CHUNK = 240  # images per batch


@torch.inference_mode()
def encoded_pictures(towers: Towers, pictures: Pictures, rows: NDArray[np.int64]) -> NDArray[np.float32]:
    """Compute unit descriptors (B, D) of images.

    Args:
        towers: trained towers.
        pictures: images of one camera.
        rows: rows of ``pictures`` (B,).
    """
    towers.eval()
    parts = [towers.camera(pictures.planes(rows[k : k + CHUNK])).numpy() for k in range(0, len(rows), CHUNK)]
    return np.concatenate(parts)


@torch.inference_mode()
def encoded_places(
    towers: Towers,
    views: LidarViews,
    sweeps: Sweeps,
    rows: NDArray[np.int64],
    report: Callable[[int], None] = lambda _: None,
) -> NDArray[np.float32]:
    """Compute unit descriptors (B * headings, D) of the views of frames; the views of a frame are adjacent.

    Args:
        towers: trained towers.
        views: views of a place for the LiDAR tower.
        sweeps: LiDAR frames.
        rows: rows of ``sweeps`` (B,).
        report: receives the number of encoded views.
    """
    towers.eval()
    at, heading = np.repeat(rows, views.headings), np.tile(fan(views), len(rows))
    parts = []
    for k in range(0, len(at), CHUNK):
        parts.append(towers.lidar(views.planes(sweeps, at[k : k + CHUNK], heading[k : k + CHUNK])).numpy())
        report(min(k + CHUNK, len(at)))
    return np.concatenate(parts)
