"""How well a registered pose is known: from the information that the points brought, made honest."""

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

#: The points of one picture err together (correlated disparities, the survey's own pose error), so they know far less than
#: their number says: standard deviations are this many times what independent points would give, the more the noisier the
#: picture, since noise that neighbours share does not show in their differences (decision log: watch cities).
INFLATION, AT_NOISE, POWER = 3.75, 0.00095, 0.31
LEAST, MOST = 3.0, 8.0
#: And never less than these: x, y, z (m), tilts and heading (rad).
_FLOOR = np.array([0.03, 0.03, 0.018, *np.deg2rad([0.03, 0.03, 0.05])])
#: What is known beside the points, weakly: position, height, tilt, heading, scale (log), disparity offset.
_PRIOR_SIGMA = np.array([30.0, 30.0, 0.3, *np.deg2rad([2.0, 2.0, 10.0]), 0.01, 0.3])


def inflation(noise: float) -> float:
    """By how much standard deviations are larger than independent points would have them.

    Args:
        noise: standard deviation of one pixel's inverse depth, 1/m.
    """
    return float(np.clip(INFLATION * (max(noise, 1e-9) / AT_NOISE) ** POWER, LEAST, MOST))


def covariance_of(
    information: Float64[NDArray[np.float64], "8 8"], noise: float
) -> Float64[NDArray[np.float64], "6 6"]:
    """Covariance of translation (m) and rotation (rad), map axes, about the camera's centre; translation first.

    Scale and disparity offset are unknowns like the others: what they cost the pose in certainty is in it.

    Args:
        information: of the points, without priors: translation, rotation, log scale, disparity offset.
        noise: of the pictures, as in ``inflation``.
    """
    pose = np.linalg.inv(information / inflation(noise) ** 2 + np.diag(_PRIOR_SIGMA**-2.0))[:6, :6]
    symmetric: Float64[NDArray[np.float64], "6 6"] = 0.5 * (pose + pose.T) + np.diag(_FLOOR**2)
    return symmetric
