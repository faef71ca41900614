"""Draw a map from above."""

import cv2
import numpy as np
from numpy.typing import NDArray

_PAPER = np.array([250, 249, 246], np.float32)


def preview_webp(
    positions: NDArray[np.float64], normals: NDArray[np.float32], track: NDArray[np.float64], *, longest_px: int = 1200
) -> bytes:
    """Draw a WebP image of a map: walls dark, ground light, the track of the survey in colour.

    A pixel is the darker, the more vertical surfels it has.

    Args:
        positions: positions of the surfels, metres, map frame (n, 3).
        normals: unit normals of the surfels, map frame (n, 3).
        track: positions of the places, metres, map frame (P, 3).
        longest_px: length of the longer side of the image, pixels.
    """
    everything = np.concatenate([positions[:, :2], track[:, :2]])
    low, high = everything.min(axis=0) - 5, everything.max(axis=0) + 5
    metre = longest_px / max(1.0, float((high - low).max()))
    width, height = (int(x) + 1 for x in (high - low) * metre)
    pixel = ((positions[:, :2] - low) * metre).astype(int)
    flat = (height - 1 - pixel[:, 1]) * width + pixel[:, 0]
    upright = np.abs(normals[:, 2]) < 0.5
    walls = np.bincount(flat[upright], minlength=width * height).reshape(height, width)
    ground = np.bincount(flat[~upright], minlength=width * height).reshape(height, width)
    dark = np.clip(np.log1p(walls) / np.log(12.0), 0, 1)[..., None].astype(np.float32)
    grey = (ground > 0)[..., None] * np.array([26, 25, 22], np.float32)
    picture = (_PAPER - grey) * (1 - dark) + np.array([52, 44, 40], np.float32) * dark
    for x, y in ((track[:, :2] - low) * metre).astype(int):
        cv2.circle(
            picture, (int(x), int(height - 1 - y)), max(1, round(0.6 * metre)), (40.0, 90.0, 225.0), -1, cv2.LINE_AA
        )
    return cv2.imencode(".webp", picture.astype(np.uint8), [cv2.IMWRITE_WEBP_QUALITY, 80])[1].tobytes()
