"""Fuse colour and depth by the IHS transform (paper, II.VII, eq. 9): depth replaces the intensity, and the colour stays.

I = (R + G + B) / sqrt(3). White has I = sqrt(3) for RGB in 0..1, and 441.67 for RGB in 0..255. Fusion needs V1 and V2, not the hue and
saturation that follow from them. Those, and the geometric transform (eq. 10-13), are in ``research/baselines/paper/ihs.py``.

The network gets planes of floating values, never a clipped RGB image. ``picture_of`` draws an image for people.
"""

from typing import NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float, Float32, UInt8
from numpy.typing import NDArray

#: Floating type. Every function returns the precision of its input.
F = TypeVar("F", np.float32, np.float64)
Rgb = UInt8[NDArray[np.uint8], "H W 3"]

#: Matrix with rows I, V1, V2 (eq. 9). The rows are orthonormal, so the inverse is the transpose.
IHS_FROM_RGB: NDArray[np.float64] = np.array(
    [
        [1 / np.sqrt(3), 1 / np.sqrt(3), 1 / np.sqrt(3)],
        [-1 / np.sqrt(6), -1 / np.sqrt(6), 2 / np.sqrt(6)],
        [-1 / np.sqrt(2), 1 / np.sqrt(2), 0.0],
    ]
)
#: Grey levels of the nearest and of the farthest depth in an image for people. They keep away from white and black, so colour
#: has room.
NEAR_LEVEL, FAR_LEVEL = 215.0, 40.0


def ihs_linear(
    rgb: Float[NDArray[F], "*shape 3"],
) -> tuple[Float[NDArray[F], "*shape"], Float[NDArray[F], "*shape"], Float[NDArray[F], "*shape"]]:
    """Convert RGB to I, V1 and V2 (paper, eq. 9).

    Args:
        rgb: any scale, e.g. 0..1 or 0..255, and any shape (..., 3). A single colour is (1, 3).

    Returns:
        I, V1 and V2 on the scale of ``rgb``. For RGB in 0..1: I in 0..sqrt(3), V1 in +-2/sqrt(6), V2 in +-1/sqrt(2).
    """
    ihs = rgb @ IHS_FROM_RGB.T.astype(rgb.dtype)
    return ihs[..., 0], ihs[..., 1], ihs[..., 2]


def rgb_from_linear(
    i: Float[NDArray[F], "*shape"], v1: Float[NDArray[F], "*shape"], v2: Float[NDArray[F], "*shape"]
) -> Float[NDArray[F], "*shape 3"]:
    """Convert I, V1 and V2 to RGB: the exact inverse of eq. 9, never clipped.

    Args:
        i: intensity as in eq. 9, any scale.
        v1: first colour plane, on the scale of ``i``.
        v2: second colour plane, on the scale of ``i``.
    """
    rgb: NDArray[F] = np.stack([i, v1, v2], axis=-1) @ IHS_FROM_RGB.astype(i.dtype)
    return rgb


class Fused(NamedTuple):
    """Fused colour and depth.

    Attributes:
        planes: depth (the unit of the input), V1 and V2 (grey levels, white is 255; never clipped or rounded).
        intensity: I of eq. 9, which the depth replaces, 0..441.67. The brightness plane of the encoder is made from it.
    """

    planes: Float32[NDArray[np.float32], "3 *shape"]
    intensity: Float32[NDArray[np.float32], "*shape"]


def fuse(
    rgb: UInt8[NDArray[np.uint8], "*shape 3"] | Float32[NDArray[np.float32], "*shape 3"],
    depth_m: Float32[NDArray[np.float32], "*shape"],
) -> Fused:
    """Replace the intensity by depth and keep the colour planes (paper, II.VII, eq. 9).

    Args:
        rgb: sRGB in 0..255, of any shape: an image, a view grid, single points. Resampled colour is float32.
        depth_m: depth or range in metres, 0 where nothing was measured.

    Returns:
        The planes, with V1 within +-208.2 and V2 within +-180.3, and the intensity.
    """
    intensity, v1, v2 = ihs_linear(rgb.astype(np.float32, copy=False))
    return Fused(np.stack([depth_m, v1, v2]), intensity)


def picture_of(planes: Float32[NDArray[np.float32], "3 H W"], max_range_m: float) -> Rgb:
    """Draw fused planes as the 2.5D image that the paper shows, for people and not for the network.

    Near pixels are bright. Pixels at ``max_range_m`` and beyond are dark. Pixels without a measurement are black. The colour
    keeps its hue, and as much of its saturation as fits between black and white.

    Args:
        planes: depth in metres, V1 and V2 in grey levels, as ``fuse`` returns them.
        max_range_m: depth that is drawn darkest, metres.

    Returns:
        sRGB image for display.
    """
    depth_m, v1, v2 = planes
    nearness = 1 - np.clip(depth_m / max_range_m, 0, 1)
    level = (FAR_LEVEL + (NEAR_LEVEL - FAR_LEVEL) * nearness)[..., None]
    colour = rgb_from_linear(np.zeros_like(v1), v1, v2)
    above = np.maximum(colour.max(axis=-1, keepdims=True), 1e-6)
    below = np.maximum(-colour.min(axis=-1, keepdims=True), 1e-6)
    share = np.minimum(1, np.minimum((255 - level) / above, level / below))
    picture = np.where(depth_m[..., None] > 0, level + share * colour, 0)
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)
