"""How well a registered pose is known: from the points' information and from how much the picture's patches disagree."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from service.geometry.rigid import rotation_z

#: Of a precise camera, 1/m.
AT_NOISE = 0.00095
#: The noises that the models were fitted for; beyond them the factors stay.
LEAST, MOST = 0.0006, 0.009
#: What is known beside the measurements, weakly: position, height, tilt, heading, scale (log), disparity offset.
_PRIOR_SIGMA = np.array([30.0, 30.0, 0.3, *np.deg2rad([2.0, 2.0, 10.0]), 0.01, 0.3])


@dataclass(frozen=True, slots=True, kw_only=True)
class CovarianceModel:
    """How many times more than it says each part of a pose's doubt is.

    Attributes:
        independent: standard deviations of what measures on its own, at ``AT_NOISE``;
        independent_power: of the noise over ``AT_NOISE`` that this goes by.
        shared: standard deviations of what patches err on their own.
        axes: factors along the view, across it, of height, of turns about these (roll, pitch, heading), at ``AT_NOISE``;
        axes_power: of the noise, likewise.
        floor: no deviation is less: x, y, z (m), roll, pitch, heading (degrees).
    """

    independent: float
    independent_power: float
    shared: float
    axes: tuple[float, ...]
    axes_power: tuple[float, ...]
    floor: tuple[float, ...]


#: Fitted on calibration cities (decision log): of registered points,
OF_POINTS = CovarianceModel(
    independent=2.25, independent_power=0.52, shared=2.4, axes=(1.0, 1.0, 1.12, 0.8, 0.8, 1.0),
    axes_power=(0.0, 0.0, -0.3, -0.22, -0.22, 0.03), floor=(0.025, 0.025, 0.017, 0.03, 0.03, 0.05),
)  # fmt: skip
#: and of rays.
OF_RAYS = CovarianceModel(
    independent=1.17, independent_power=0.52, shared=2.97, axes=(1.42, 0.91, 0.73, 0.8, 0.8, 1.05),
    axes_power=(0.05, 0.0, -0.18, -0.22, -0.22, -0.04), floor=(0.022, 0.022, 0.0175, 0.028, 0.028, 0.01),
)  # fmt: skip


def covariance_of(
    information: Float64[NDArray[np.float64], "8 8"], scatter: Float64[NDArray[np.float64], "8 8"], noise: float, heading_rad: float,
    model: CovarianceModel,
) -> Float64[NDArray[np.float64], "6 6"]:  # fmt: skip
    """Covariance of translation (m) and rotation (rad), map axes, about the camera's centre; translation first.

    Scale and disparity offset are unknowns like the others: what they cost the pose in certainty is in it.

    Args:
        information: of the measurements, without priors: translation, rotation, log scale, disparity offset.
        scatter: of the patches' pulls, as in ``scatter_of``.
        noise: standard deviation of one pixel's inverse depth, 1/m.
        heading_rad: of the view, map frame.
        model: of what was minimised.
    """
    ratio = float(np.clip(noise, LEAST, MOST)) / AT_NOISE
    prior = np.diag(_PRIOR_SIGMA**-2.0)
    bread = np.linalg.inv(information + prior)
    shared = model.shared**2 * bread @ scatter @ bread
    independent = np.linalg.inv(information / (model.independent * ratio**model.independent_power) ** 2 + prior)
    to_map = np.kron(np.eye(2), rotation_z(heading_rad))
    stretch = to_map @ np.diag(np.array(model.axes) * ratio ** np.array(model.axes_power)) @ to_map.T
    floor = np.array([*model.floor[:3], *np.deg2rad(model.floor[3:])])
    pose = stretch @ (shared + independent)[:6, :6] @ stretch
    symmetric: Float64[NDArray[np.float64], "6 6"] = 0.5 * (pose + pose.T) + np.diag(floor**2)
    return symmetric
