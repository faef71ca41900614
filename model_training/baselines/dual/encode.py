"""Descriptors of many pictures and of many places' views, by trained towers."""

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray

from model_training.baselines.dual.lidar_views import LidarViews, fan
from model_training.baselines.dual.pictures import Pictures, Sweeps
from model_training.baselines.dual.towers import Towers

CHUNK = 240  # images at once


@torch.inference_mode()
def encoded_pictures(towers: Towers, pictures: Pictures, rows: NDArray[np.int64]) -> NDArray[np.float32]:
    """Unit descriptors (B, D) of some pictures."""
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
    """Unit descriptors (B * headings, D) of the views of some frames, a frame's views next to each other."""
    towers.eval()
    at, heading = np.repeat(rows, views.headings), np.tile(fan(views), len(rows))
    parts = []
    for k in range(0, len(at), CHUNK):
        parts.append(towers.lidar(views.planes(sweeps, at[k : k + CHUNK], heading[k : k + CHUNK])).numpy())
        report(min(k + CHUNK, len(at)))
    return np.concatenate(parts)
