"""Hue and saturation in both forms of the paper: linear (eq. 9) and geometric (eq. 10-13).

Fusion replaces I and keeps V1 and V2, so neither the product nor the paper's method needs them. They complete the equations of the paper.

The two forms differ in the scale of I and in the zero of the hue:

- Linear (``service.imaging.fusion``): I = (R + G + B) / sqrt(3). White has I = sqrt(3) for RGB in 0..1, and 441.67 for RGB in 0..255.
  The hue is 0 at blue and passes green before red.
- Geometric: I = (R + G + B) / 3. White has I = 1 for RGB in 0..1, and 255 for RGB in 0..255.
  The hue is 0 at red and passes green before blue.

So ``H_linear = 4 pi / 3 - H_geometric``.
"""

from typing import TypeVar

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

#: Floating type. Every function returns the precision of its input.
F = TypeVar("F", np.float32, np.float64)

#: A pixel is grey, with hue 0, if its channels differ by no more than this share of the largest one. Such a difference is
#: rounding, not colour.
GREY_SHARE = 1e-6


def hue_saturation_linear(
    v1: Float[NDArray[F], "*shape"], v2: Float[NDArray[F], "*shape"]
) -> tuple[Float[NDArray[F], "*shape"], Float[NDArray[F], "*shape"]]:
    """Convert V1 and V2 to hue and saturation (paper, eq. 9).

    The paper has arctan. We use atan2, which gives the quadrant too.

    Args:
        v1: first colour plane, on the scale of RGB.
        v2: second colour plane, on the scale of RGB.

    Returns:
        Hue: radians in [0, 2 pi). Blue is 0, green 2 pi / 3, red 4 pi / 3. It is 0 without colour.
        Saturation: on the scale of RGB. It is 0 for grey, and at most sqrt(2/3) of full scale.
    """
    return _positive_angle(np.arctan2(v2, v1)), np.hypot(v1, v2)


def planes_from_hue_saturation(
    h_rad: Float[NDArray[F], "*shape"], s: Float[NDArray[F], "*shape"]
) -> tuple[Float[NDArray[F], "*shape"], Float[NDArray[F], "*shape"]]:
    """Convert linear hue and saturation to V1 and V2: the inverse of ``hue_saturation_linear``.

    Args:
        h_rad: hue, radians.
        s: saturation, on the scale of RGB.
    """
    return s * np.cos(h_rad), s * np.sin(h_rad)


def ihs_geometric(
    rgb: Float[NDArray[F], "*shape 3"],
) -> tuple[Float[NDArray[F], "*shape"], Float[NDArray[F], "*shape"], Float[NDArray[F], "*shape"]]:
    """Convert RGB to intensity, hue and saturation of the colour cube (paper, eq. 10-13).

    The hue is the angle of eq. 10 and 11. We compute it by atan2, because arccos loses half of the digits near red and cyan.
    On grey, the equations divide zero by zero.

    Args:
        rgb: not negative, any scale, any shape (..., 3).

    Returns:
        I: on the scale of RGB. White has 1 for RGB in 0..1.
        H: radians in [0, 2 pi). Red is 0, green 2 pi / 3, blue 4 pi / 3. It is 0 without colour.
        S: in 0..1. It is 0 for grey and black, and 1 where one channel is zero.
    """
    r, g, b = rgb[..., 0], rgb[..., 1], rgb[..., 2]
    intensity = ((r + g + b) / 3).astype(rgb.dtype)
    smallest = np.minimum(np.minimum(r, g), b)
    largest = np.maximum(np.maximum(r, g), b)
    grey = largest - smallest <= GREY_SHARE * largest
    divisor = np.where(intensity > 0, intensity, 1).astype(rgb.dtype)
    saturation = np.where(grey, 0, np.clip(1 - smallest / divisor, 0, 1)).astype(rgb.dtype)
    angle = np.arctan2(np.sqrt(rgb.dtype.type(3)) * (g - b), (r - g) + (r - b))
    hue = np.where(grey, 0, _positive_angle(angle)).astype(rgb.dtype)
    return intensity, hue, saturation


def rgb_from_geometric(
    i: Float[NDArray[F], "*shape"], h_rad: Float[NDArray[F], "*shape"], s: Float[NDArray[F], "*shape"]
) -> Float[NDArray[F], "*shape 3"]:
    """Convert intensity, hue and saturation of the colour cube to RGB (the sectors of Gonzalez and Woods).

    Args:
        i: intensity, any scale.
        h_rad: hue, any angle in radians.
        s: saturation, 0..1.

    Returns:
        RGB on the scale of ``i``, never clipped. Bright and saturated colours outside the cube stay outside.
    """
    third = 2 * np.pi / 3
    hue = np.mod(h_rad, 2 * np.pi)
    sector = np.minimum(hue // third, 2).astype(np.intp)
    within = hue - sector * third
    low = i * (1 - s)
    first = i * (1 + s * np.cos(within) / np.cos(np.pi / 3 - within))
    second = 3 * i - (low + first)
    # Sector 0 (red to green) has first = R, second = G, low = B. Each further sector shifts the channels by one.
    turned = np.stack([first, second, low], axis=-1)
    channel = (np.arange(3) - sector[..., None]) % 3
    rgb: NDArray[F] = np.take_along_axis(turned, channel, axis=-1).astype(i.dtype)
    return rgb


def _positive_angle(angle_rad: Float[NDArray[F], "*shape"]) -> Float[NDArray[F], "*shape"]:
    """Wrap an angle in [-2 pi, 2 pi) to [0, 2 pi), also where rounding would give 2 pi."""
    full = angle_rad.dtype.type(2 * np.pi)
    turned = np.where(angle_rad < 0, angle_rad + full, angle_rad)
    positive: NDArray[F] = np.where(turned >= full, 0, turned).astype(angle_rad.dtype)
    return positive
