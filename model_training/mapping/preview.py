"""Draw a map from above."""

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from model_training.mapping.voxel_map import parts
from service.registration.surfel_map import SurfelMap

_PAPER = np.array([250, 249, 246], np.float32)


def preview_webp(cloud: SurfelMap | None, track: NDArray[np.float64], *, longest_px: int = 1200) -> bytes:
    """Draw a WebP image of a map: walls dark, ground light, the track of the survey in colour.

    A pixel is the darker, the more vertical surfels it has.

    Args:
        cloud: cloud of the map; None for a map without a cloud.
        track: positions of the places, metres, map frame (P, 3).
        longest_px: length of the longer side of the image, pixels.
    """
    low, high = track[:, :2].min(axis=0), track[:, :2].max(axis=0)
    for positions, _ in _parts(cloud):
        low, high = np.minimum(low, positions.min(axis=0)), np.maximum(high, positions.max(axis=0))
    low, high = low - 5, high + 5
    metre = longest_px / max(1.0, float((high - low).max()))
    width, height = (int(x) + 1 for x in (high - low) * metre)
    walls, ground = np.zeros((2, height * width), np.int64)
    for positions, upright in _parts(cloud):
        pixel = ((positions - low) * metre).astype(int)
        flat = (height - 1 - pixel[:, 1]) * width + pixel[:, 0]
        walls += np.bincount(flat[upright], minlength=height * width)
        ground += np.bincount(flat[~upright], minlength=height * width)
    walls, ground = walls.reshape(height, width), ground.reshape(height, width)
    dark = np.clip(np.log1p(walls) / np.log(12.0), 0, 1)[..., None].astype(np.float32)
    grey = (ground > 0)[..., None] * np.array([26, 25, 22], np.float32)
    picture = (_PAPER - grey) * (1 - dark) + np.array([52, 44, 40], np.float32) * dark
    for x, y in ((track[:, :2] - low) * metre).astype(int):
        cv2.circle(
            picture, (int(x), int(height - 1 - y)), max(1, round(0.6 * metre)), (40.0, 90.0, 225.0), -1, cv2.LINE_AA
        )
    return cv2.imencode(".webp", picture.astype(np.uint8), [cv2.IMWRITE_WEBP_QUALITY, 80])[1].tobytes()


def _parts(cloud: SurfelMap | None) -> Iterator[tuple[NDArray[np.float64], NDArray[np.bool_]]]:
    """Yield x and y of surfels (n, 2), metres, map frame, and which of them are upright (n,). Not all at once, to save memory."""
    if cloud is None:
        return
    for part in parts(len(cloud.surfels)):
        surfels = cloud.unpacked(part)
        yield surfels["xyz"][:, :2] + cloud.origin_m[:2], np.abs(surfels["normal"][:, 2]) < 0.5
