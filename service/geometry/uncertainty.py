"""Propagate the covariance of a pose to another reference point of the same rigid body."""

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray


def covariance_at(
    covariance: Float64[NDArray[np.float64], "6 6"],
    from_m: Float64[NDArray[np.float64], "3"],
    to_m: Float64[NDArray[np.float64], "3"],
) -> Float64[NDArray[np.float64], "6 6"]:
    """Propagate a pose covariance from one reference point of a rigid body to another (adjoint).

    All arguments use the same axes.

    Args:
        covariance: covariance about ``from_m``: translation (m) first, then rotation (rad).
        from_m: reference point of ``covariance``, metres.
        to_m: new reference point, metres.
    """
    x, y, z = to_m - from_m
    lever = np.eye(6)
    lever[:3, 3:] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]  # translation at to_m: t + rotation x (to_m - from_m)
    moved: Float64[NDArray[np.float64], "6 6"] = lever @ covariance @ lever.T
    return moved
