"""What is known of one point of a rigid body from what is known of another."""

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray


def covariance_at(
    covariance: Float64[NDArray[np.float64], "6 6"], from_m: Float64[NDArray[np.float64], "3"], to_m: Float64[NDArray[np.float64], "3"]
) -> Float64[NDArray[np.float64], "6 6"]:  # fmt: skip
    """What a pose's covariance at one point of a rigid body says of another point of it.

    Args:
        covariance: translation (m) first, then rotation (rad), in the axes that the points are given in, about ``from_m``.
        from_m: the point that it is about.
        to_m: the other one.
    """
    x, y, z = to_m - from_m
    lever = np.eye(6)
    lever[:3, 3:] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]  # turning about one moves the other: rotation x lever
    moved: Float64[NDArray[np.float64], "6 6"] = lever @ covariance @ lever.T
    return moved
