"""Fuse colour and depth by IHS (paper, II.VII): depth replaces the intensity, and the colour stays.

The network gets planes of floating values, never a clipped RGB image. ``picture_of`` draws an image for people.
"""

import numpy as np
from jaxtyping import Float32, UInt8
from numpy.typing import NDArray

from service.imaging.ihs import ihs_linear, rgb_from_linear

Rgb = UInt8[NDArray[np.uint8], "H W 3"]
Depth = Float32[NDArray[np.float32], "H W"]
Fused = Float32[NDArray[np.float32], "3 H W"]

#: Grey levels of the nearest and of the farthest depth in an image for people. They keep away from white and black, so colour
#: has room.
NEAR_LEVEL, FAR_LEVEL = 215.0, 40.0


def fuse(rgb: Rgb, depth_m: Depth) -> Fused:
    """Replace the intensity by depth and keep the colour planes (paper, II.VII, eq. 9).

    Args:
        rgb: sRGB image.
        depth_m: metres along the optical axis, 0 where nothing was measured.

    Returns:
        Planes depth_m, V1 and V2. V1 and V2 are in grey levels (white is 255), never clipped or rounded.
    """
    return fuse_planes(rgb.astype(np.float32), depth_m)


def fuse_planes(
    rgb: Float32[NDArray[np.float32], "*shape 3"], depth_m: Float32[NDArray[np.float32], "*shape"]
) -> Float32[NDArray[np.float32], "3 *shape"]:
    """Fuse colour and depth like ``fuse``, for arrays of any shape: images, view grids, single points.

    Args:
        rgb: sRGB in 0..255, e.g. resampled.
        depth_m: depth or range in metres, 0 where nothing was measured.

    Returns:
        Planes depth_m, V1 (within +-208.2) and V2 (within +-180.3), with the plane as first axis.
    """
    return fuse_and_keep(rgb, depth_m)[0]


def fuse_and_keep(
    rgb: Float32[NDArray[np.float32], "*shape 3"], depth_m: Float32[NDArray[np.float32], "*shape"]
) -> tuple[Float32[NDArray[np.float32], "3 *shape"], Float32[NDArray[np.float32], "*shape"]]:
    """Fuse colour and depth like ``fuse_planes``, and keep the intensity that the depth replaces.

    The request path calls this: the brightness plane of the encoder is made from the intensity.

    Args:
        rgb: sRGB in 0..255, e.g. resampled.
        depth_m: depth or range in metres, 0 where nothing was measured.

    Returns:
        The planes of ``fuse_planes``, and I (eq. 9) in 0..441.67.
    """
    intensity, v1, v2 = ihs_linear(rgb)
    return np.stack([depth_m, v1, v2]), intensity


def picture_of(fused: Fused, max_range_m: float) -> Rgb:
    """Draw fused planes as the 2.5D image that the paper shows, for people and not for the network.

    Near pixels are bright. Pixels at ``max_range_m`` and beyond are dark. Pixels without a measurement are black. The colour
    keeps its hue, and as much of its saturation as fits between black and white.

    Args:
        fused: depth in metres, V1 and V2 in grey levels.
        max_range_m: depth that is drawn darkest, metres.

    Returns:
        sRGB image for display.
    """
    depth_m, v1, v2 = fused
    nearness = 1 - np.clip(depth_m / max_range_m, 0, 1)
    level = (FAR_LEVEL + (NEAR_LEVEL - FAR_LEVEL) * nearness)[..., None]
    colour = rgb_from_linear(np.zeros_like(v1), v1, v2)
    above = np.maximum(colour.max(axis=-1, keepdims=True), 1e-6)
    below = np.maximum(-colour.min(axis=-1, keepdims=True), 1e-6)
    share = np.minimum(1, np.minimum((255 - level) / above, level / below))
    picture = np.where(depth_m[..., None] > 0, level + share * colour, 0)
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)
