"""How well a registered pose is known: from the points' information and from how much the picture's patches disagree."""

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

#: Standard deviations at ``AT_NOISE``, a precise camera's: of independent points, and of patches that err on their own, each this
#: many times what it says. Between that and a stereo rig's noise the points' factor goes by a power of the noise (decision log).
AT_NOISE = 0.00095
INDEPENDENT, INDEPENDENT_POWER = 2.25, 0.52
SHARED = 2.4
#: By axis, at ``AT_NOISE``: height, tilts, heading.
_AXES, _AXES_POWER = np.array([1.0, 1.0, 1.12, 0.8, 0.8, 1.0]), np.array([0.0, 0.0, -0.3, -0.22, -0.22, 0.03])
#: The noises that this was fitted for; beyond them the factors stay.
LEAST, MOST = 0.0006, 0.009
#: And never less than these: x, y, z (m), tilts and heading (rad).
_FLOOR = np.array([0.025, 0.025, 0.017, *np.deg2rad([0.03, 0.03, 0.05])])
#: What is known beside the points, weakly: position, height, tilt, heading, scale (log), disparity offset.
_PRIOR_SIGMA = np.array([30.0, 30.0, 0.3, *np.deg2rad([2.0, 2.0, 10.0]), 0.01, 0.3])


def covariance_of(
    information: Float64[NDArray[np.float64], "8 8"], scatter: Float64[NDArray[np.float64], "8 8"], noise: float
) -> Float64[NDArray[np.float64], "6 6"]:
    """Covariance of translation (m) and rotation (rad), map axes, about the camera's centre; translation first.

    Scale and disparity offset are unknowns like the others: what they cost the pose in certainty is in it.

    Args:
        information: of the points, without priors: translation, rotation, log scale, disparity offset.
        scatter: of the patches' pulls, as in ``scatter_of``.
        noise: standard deviation of one pixel's inverse depth, 1/m.
    """
    ratio = float(np.clip(noise, LEAST, MOST)) / AT_NOISE
    prior = np.diag(_PRIOR_SIGMA**-2.0)
    bread = np.linalg.inv(information + prior)
    shared = SHARED**2 * bread @ scatter @ bread
    independent = np.linalg.inv(information / (INDEPENDENT * ratio**INDEPENDENT_POWER) ** 2 + prior)
    axes = _AXES * ratio**_AXES_POWER
    pose = (shared + independent)[:6, :6] * np.outer(axes, axes)
    symmetric: Float64[NDArray[np.float64], "6 6"] = 0.5 * (pose + pose.T) + np.diag(_FLOOR**2)
    return symmetric
