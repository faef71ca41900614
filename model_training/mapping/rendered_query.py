"""Errors and grey levels of images that are rendered from a survey: for the site check and for the correction of a rig."""

import numpy as np
from numpy.typing import NDArray

#: Grey level of the median LiDAR intensity.
_MIDDLE_GREY = 110


def noisy_depth(
    z_m: NDArray[np.floating],
    noise: NDArray[np.float64] | float,
    group: NDArray[np.int64],
    groups: int,
    rng: np.random.Generator,
    *,
    largest_m: float,
) -> NDArray[np.float32]:
    """Return a depth image with an error of the inverse depth.

    Half of the variance is common to a group of pixels, such as those of one beam. The other half differs from pixel to pixel.

    Args:
        z_m: exact depth (H, W), metres; 0 where there is none.
        noise: standard deviation of the inverse depth, 1/m: one number, or (H, W).
        group: index of each pixel's group (H, W).
        groups: number of groups.
        rng: random generator.
        largest_m: depths beyond this value become 0, metres.
    """
    shared, own = rng.normal(0, 1, groups), rng.normal(0, 1, z_m.shape)
    error = noise * np.sqrt(0.5) * (shared[group] + own)
    inverse = np.where(z_m > 0, 1 / np.where(z_m > 0, z_m, 1) + error, 0)
    return np.where(inverse > 1 / largest_m, 1 / np.where(inverse > 0, inverse, 1), 0).astype(np.float32)


def grey_image(intensity: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return an RGB image (H, W, 3) whose grey levels follow the LiDAR intensity; black where there is no return.

    Args:
        intensity: LiDAR intensity of each pixel (H, W), in the sensor's unit; 0 where there is none.
    """
    middle = float(np.median(intensity[intensity > 0])) if (intensity > 0).any() else 1.0
    grey = np.clip(_MIDDLE_GREY * intensity / middle, 0, 255)
    return np.repeat(grey.astype(np.uint8)[..., None], 3, axis=2)
