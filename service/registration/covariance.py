"""Covariance of a registered pose: a sandwich of its information and of the disagreement of the image's patches."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int32
from numpy.typing import NDArray

from service.geometry.rigid import rotation_z
from service.registration.kernel import STATE, UNKNOWNS, QueryPoints, gradients
from service.registration.register import Registered, RegistrationSettings
from service.registration.surfel_map import SurfelMap

#: Reference noise of the models: standard deviation of an inverse depth of a precise camera, 1/m.
AT_NOISE = 0.00095
#: Range of noise that the models were fitted for, 1/m. Noise outside this range is clipped.
LEAST, MOST = 0.0006, 0.009
#: Standard deviations of weak priors: x and y (m), z (m), roll and pitch (rad), heading (rad), log scale, disparity offset (px).
_PRIOR_SIGMA = np.array([30.0, 30.0, 0.3, *np.deg2rad([2.0, 2.0, 10.0]), 0.01, 0.3])
#: Width of a patch, rad. The points of a patch share errors. Matching errors are correlated over 16 to 60 of 640 pixels. A parked car
#: that the survey did not see is as wide. Chosen among 0.05, 0.1, 0.2 and 0.3 rad on validation cities (decision 0037).
PATCH_RAD = 0.2
#: Least eigenvalue of the normalised information (unit diagonal) of an observable direction. For comparison: a wall's distance against
#: the scale has 4e-6.
_OBSERVABLE = 1e-4
#: Least variance inflation. Its logarithm is a confidence feature, so it must not be 0.
_LEAST = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True)
class CovarianceModel:
    """Inflation factors of the covariance.

    Each factor multiplies standard deviations. Decision 0037 explains the two parts of the covariance.

    Attributes:
        independent: factor of the part with independent errors, at ``AT_NOISE``.
        independent_power: exponent of (noise / ``AT_NOISE``) in that factor.
        shared: factor of the part with errors that the pixels of a patch share.
        axes: six factors at ``AT_NOISE``: along the view, across it, height, and rotations about these axes (roll, pitch, heading).
        axes_power: exponents of (noise / ``AT_NOISE``) in the factors ``axes``.
        floor: least standard deviations: x, y, z (m), roll, pitch, heading (degrees).
    """

    independent: float
    independent_power: float
    shared: float
    axes: tuple[float, ...]
    axes_power: tuple[float, ...]
    floor: tuple[float, ...]


#: Model for poses that ``register`` found from points. Fitted on calibration cities (decisions 0042 and 0081).
OF_POINTS = CovarianceModel(
    independent=2.25,
    independent_power=0.52,
    shared=2.4,
    axes=(1.0, 1.0, 1.12, 0.8, 0.8, 1.0),
    axes_power=(0.0, 0.0, -0.3, -0.22, -0.22, 0.03),
    floor=(0.025, 0.025, 0.017, 0.03, 0.03, 0.05),
)
#: Model for poses that ``adjust`` refined along the rays. Fitted on calibration cities (decisions 0098 and 0100).
OF_RAYS = CovarianceModel(
    independent=1.17,
    independent_power=0.52,
    shared=2.97,
    axes=(1.42, 0.91, 0.73, 0.8, 0.8, 1.05),
    axes_power=(0.05, 0.0, -0.18, -0.22, -0.22, -0.04),
    floor=(0.022, 0.022, 0.0175, 0.028, 0.028, 0.01),
)


#: Standard deviations of a survey's poses that the floors of the models above contain: position (m) and angle (degrees).
FLOOR_SURVEY_M, FLOOR_SURVEY_DEG = 0.03, 0.05


def survey_covariance(position_std_m: float | None, angle_std_deg: float | None) -> Float64[NDArray[np.float64], "6 6"]:
    """Return the covariance that the errors of the survey's poses add to a pose in the map: translation (m), then rotation (rad).

    A query is registered to the scans around it, and their common error moves its pose. The scans cannot show this error, because they
    agree with each other. So the map states it. The floors of the models contain a survey with usual errors. Only the excess is added.

    Args:
        position_std_m: standard deviation of the survey's positions per axis, metres; None counts as usual.
        angle_std_deg: standard deviation of the survey's angles, degrees; None counts as usual.
    """
    position = max((position_std_m or 0.0) ** 2 - FLOOR_SURVEY_M**2, 0.0)
    angle = max((angle_std_deg or 0.0) ** 2 - FLOOR_SURVEY_DEG**2, 0.0) * np.deg2rad(1.0) ** 2
    return np.diag([position] * 3 + [angle] * 3)


#: Standard deviation of roll and pitch from the rectification of a stereo pair, degrees, at a height that equals the baseline. A right
#: camera that is rolled against the left one tilts the disparity plane, and a pair cannot show it. On the ground plane, inverse depth is
#: proportional to 1 / height and disparity to the baseline, so the tilt is proportional to height over baseline. Measured on five stereo
#: rigs of the calibration and on KITTI drive 0005 (decisions 0151 and 0157).
RECTIFICATION_DEG = 0.065
#: Largest standard deviation of this tilt, degrees.
_MOST_TILT_DEG = 3.0


def rectification_covariance(height_m: float, baseline_m: float) -> Float64[NDArray[np.float64], "6 6"]:
    """Return the covariance that the rectification of a stereo pair adds: translation (m), then rotation (rad).

    Roll and pitch get the same variance, so it holds for every heading.

    Args:
        height_m: height of the camera above the ground, metres.
        baseline_m: baseline of the stereo pair, metres.
    """
    tilt_deg = min(RECTIFICATION_DEG * height_m / baseline_m, _MOST_TILT_DEG)
    return np.diag(np.deg2rad([0, 0, 0, tilt_deg, tilt_deg, 0]) ** 2)


def covariance_of(
    information: Float64[NDArray[np.float64], "8 8"],
    scatter: Float64[NDArray[np.float64], "8 8"],
    noise: float,
    heading_rad: float,
    model: CovarianceModel,
) -> Float64[NDArray[np.float64], "6 6"]:
    """Compute the covariance of a pose: translation (m), then rotation (rad), in map axes about the camera's centre.

    The first part is a sandwich estimate (White, Econometrica 48, 1980): inverse information, scatter, inverse information.
    The second part is the inverse of the information after division by the squared factor ``independent``.
    Scale and disparity offset are marginalised.

    Args:
        information: of the measurements, without priors. Order: translation (m), rotation (rad), log scale, disparity offset (px).
        scatter: scatter of the patches' gradients in the same order, as ``score_outer_product`` or ``adjust`` returns it.
        noise: standard deviation of one pixel's inverse depth, 1/m.
        heading_rad: heading of the view in the map frame, rad.
        model: ``OF_POINTS`` or ``OF_RAYS``, as the pose was found.
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


def score_outer_product(
    cloud: SurfelMap, points: QueryPoints, found: Registered, settings: RegistrationSettings
) -> Float64[NDArray[np.float64], "8 8"]:
    """Sum the outer products of the patches' gradients at a registered pose, scaled up for few patches.

    White, Econometrica 48, 1980; Liang and Zeger, Biometrika 73, 1986. If points were independent and their variances right, the sum
    would be the information. The factor for few patches is n / (n - 8).

    Args:
        cloud: surfel map.
        points: the registered points of the query, in its level frame.
        found: the registered pose, map frame.
        settings: the settings that registered it.

    Returns:
        The scatter, in the order translation (m), rotation (rad), log scale, disparity offset (px).
    """
    state = np.zeros(1, STATE)
    state["R"], state["t"] = found.R_map_level, found.camera_m - cloud.origin_m
    state["log_scale"], state["offset"] = np.log(found.scale), found.offset
    weighed = points.with_least_weight(settings.fine_weight)
    each = gradients(cloud.grid, cloud.surfels, weighed, state, settings.fine, patches(points.ray))
    scatter: Float64[NDArray[np.float64], "8 8"] = each.T @ each * (len(each) / max(len(each) - UNKNOWNS, 1))
    return scatter


def variance_inflation(
    information: Float64[NDArray[np.float64], "8 8"], scatter: Float64[NDArray[np.float64], "8 8"]
) -> float:
    """Return the mean ratio of scatter to information (variances); it is 1 if the noise explains the residuals.

    Unobservable directions do not count. If no direction is observable, the result is 1.

    Args:
        information: information matrix of the pose, without priors.
        scatter: scatter of the patches' gradients in the same order, as ``score_outer_product`` or ``adjust`` returns it.
    """
    sizes = np.sqrt(np.maximum(np.diag(information), 1e-300))
    strength, axes = np.linalg.eigh(information / np.outer(sizes, sizes))
    observable = strength > _OBSERVABLE
    if not observable.any():
        return 1.0
    scattered = np.einsum("ik,ij,jk->k", axes[:, observable], scatter / np.outer(sizes, sizes), axes[:, observable])
    return max(float(np.mean(scattered / strength[observable])), _LEAST)


def patches(ray: Float32[NDArray[np.float32], "n 3"]) -> Int32[NDArray[np.int32], " n"]:
    """Assign each ray to a patch; patches are numbered from 0 without gaps.

    Args:
        ray: unit vectors in the level frame.
    """
    azimuth, elevation = np.arctan2(ray[:, 1], ray[:, 0]), np.arcsin(np.clip(ray[:, 2], -1, 1))
    cells = np.floor(azimuth / PATCH_RAD).astype(np.int64) * 64 + np.floor(elevation / PATCH_RAD).astype(np.int64)
    return np.unique(cells, return_inverse=True)[1].astype(np.int32)
