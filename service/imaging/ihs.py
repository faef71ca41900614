"""The linear IHS transform of the paper (eq. 9) and its inverse.

I = (R + G + B) / sqrt(3). White has I = sqrt(3) for RGB in 0..1, and 441.67 for RGB in 0..255. Fusion needs V1 and V2, not the hue and
saturation that follow from them. Those, and the geometric transform (eq. 10-13), are in ``research/baselines/paper/ihs.py``.
"""

from typing import TypeVar

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

#: Floating type. Every function returns the precision of its input.
F = TypeVar("F", np.float32, np.float64)

#: Matrix with rows I, V1, V2 (eq. 9). The rows are orthonormal, so the inverse is the transpose.
IHS_FROM_RGB: NDArray[np.float64] = np.array(
    [
        [1 / np.sqrt(3), 1 / np.sqrt(3), 1 / np.sqrt(3)],
        [-1 / np.sqrt(6), -1 / np.sqrt(6), 2 / np.sqrt(6)],
        [-1 / np.sqrt(2), 1 / np.sqrt(2), 0.0],
    ]
)


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
