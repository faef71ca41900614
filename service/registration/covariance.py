"""How well a registered pose is known: from the information that the points brought, made honest."""

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

#: The points of one picture err together (correlated disparities, the survey's own pose error), so they know far less than
#: their number says: standard deviations are this many times what independent points would give, and never less than the floor.
#: A compromise between 4, which fits precise depth, and 6, which fits a stereo rig's (decision log: watch city 2002).
INFLATION = 5.5
FLOOR_M = 0.03
FLOOR_RAD = float(np.deg2rad(0.05))
#: What is known beside the points, weakly: position, height, tilt, heading, scale (log), disparity offset.
_PRIOR_SIGMA = np.array([30.0, 30.0, 0.3, *np.deg2rad([2.0, 2.0, 10.0]), 0.01, 0.3])


def covariance_of(information: Float64[NDArray[np.float64], "8 8"]) -> Float64[NDArray[np.float64], "6 6"]:
    """Covariance of translation (m) and rotation (rad), map axes, about the camera's centre; translation first.

    Scale and disparity offset are unknowns like the others: what they cost the pose in certainty is in it.

    Args:
        information: of the points, without priors: translation, rotation, log scale, disparity offset.
    """
    pose = np.linalg.inv(information / INFLATION**2 + np.diag(_PRIOR_SIGMA**-2.0))[:6, :6]
    floor = np.diag([FLOOR_M**2] * 3 + [FLOOR_RAD**2] * 3)
    symmetric: Float64[NDArray[np.float64], "6 6"] = 0.5 * (pose + pose.T) + floor
    return symmetric
