"""Covariance of a registered pose: a sandwich of its information and of the disagreement of the image's patches."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int32
from numpy.typing import NDArray

from service.geometry.rigid import rotation_z
from service.registration.kernel import STATE, UNKNOWNS, QueryPoints, gradients
from service.registration.register import Registered, RegistrationSettings
from service.registration.surfel_tiles import Surfels

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

    Each factor multiplies standard deviations. Decision 0037 explains the first two parts of the covariance, decision 0179 the others.

    Attributes:
        shared: factor of the part with errors that the pixels of a patch share.
        axes: six factors at ``AT_NOISE``: along the view, across it, height, and rotations about these axes (roll, pitch, heading).
        axes_power: exponents of (noise / ``AT_NOISE``) in the factors ``axes``.
        floor: least standard deviations: x, y, z (m), roll, pitch, heading (degrees).
        independent: factor of the part with independent errors, at ``AT_NOISE``; 0 omits this part.
        independent_power: exponent of (noise / ``AT_NOISE``) in that factor.
        restarts: factor of the spread of restarted adjustments.
        shift: factor of the shift from the pose of the points to that of the rays.
        misfit: factors of the logarithm of the variance inflation, of the share of mapped points that are no inliers, and of the along
            residual. They scale the standard deviations above the floor: exp of their sum.
        usual: values of these three numbers at which the scale is 1.
    """

    shared: float
    axes: tuple[float, ...]
    axes_power: tuple[float, ...]
    floor: tuple[float, ...]
    independent: float = 0.0
    independent_power: float = 0.0
    restarts: float = 0.0
    shift: float = 0.0
    misfit: tuple[float, float, float] = (0.0, 0.0, 0.0)
    usual: tuple[float, float, float] = (0.0, 0.0, 0.0)


#: Model for poses that ``register`` found from points. Fitted on calibration cities (decisions 0042 and 0081).
OF_POINTS = CovarianceModel(
    independent=2.25,
    independent_power=0.52,
    shared=2.4,
    axes=(1.0, 1.0, 1.12, 0.8, 0.8, 1.0),
    axes_power=(0.0, 0.0, -0.3, -0.22, -0.22, 0.03),
    floor=(0.025, 0.025, 0.017, 0.03, 0.03, 0.05),
)
#: Model for poses that ``adjust`` refined along the rays. Fitted on the rig families of the calibration (decision 0179).
OF_RAYS = CovarianceModel(
    shared=3.6,
    axes=(1.0, 0.82, 0.75, 0.48, 0.65, 0.87),
    axes_power=(0.0,) * 6,
    floor=(0.017, 0.017, 0.018, 0.032, 0.032, 0.049),
    restarts=0.37,
    shift=0.43,
    misfit=(0.24, 0.37, -0.32),
    usual=(-0.48, 0.23, 1.56),
)
#: Limits of the scale by ``CovarianceModel.misfit``: exp of plus and minus this number.
_MOST_MISFIT = 1.5


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


#: Standard deviation of a rotation from the relative poses of several frames, degrees. Odometry and the mounts of several cameras have
#: such errors, and the frames cannot show them. Measured on sequences of five frames and on four cameras (decision 0179).
RELATIVE_POSES_DEG = 0.17


def relative_pose_covariance(frames: int) -> Float64[NDArray[np.float64], "6 6"]:
    """Return the covariance that the relative poses of a query's frames add: translation (m), then rotation (rad).

    Args:
        frames: number of frames; a single frame adds nothing.
    """
    return np.diag([0, 0, 0, 1, 1, 1]) * (np.deg2rad(RELATIVE_POSES_DEG) ** 2 if frames > 1 else 0.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Stability:
    """How stable a pose of the ray adjustment is, and how well the map explains the image there.

    Attributes:
        restarts: spread of restarted adjustments, as ``spread_of_restarts`` returns it: translation (m), rotation (rad), map axes.
        shift: difference of the pose to the pose of the points, which the adjustment began with, in the same order.
        mapped_inliers: share of the points on the map, relative to the share where the map shows a surface.
        along_residual: how many times larger the mean depth residual is 2 m further along the street.
    """

    restarts: Float64[NDArray[np.float64], "6 6"]
    shift: Float64[NDArray[np.float64], "6"]
    mapped_inliers: float
    along_residual: float


def covariance_of(
    information: Float64[NDArray[np.float64], "8 8"],
    scatter: Float64[NDArray[np.float64], "8 8"],
    noise: float,
    heading_rad: float,
    model: CovarianceModel,
    stability: Stability | None = None,
) -> Float64[NDArray[np.float64], "6 6"]:
    """Compute the covariance of a pose: translation (m), then rotation (rad), in map axes about the camera's centre.

    The first part is a sandwich estimate (White, Econometrica 48, 1980): inverse information, scatter, inverse information.
    The second part is the inverse of the information after division by the squared factor ``independent``.
    Scale and disparity offset are marginalised.

    A pose of the ray adjustment adds the spread of its restarts (Brossard and others, RA-L 5, 2020) and the outer product of its shift.
    The sum grows with the misfit of image and map.

    Args:
        information: of the measurements, without priors. Order: translation (m), rotation (rad), log scale, disparity offset (px).
        scatter: scatter of the patches' gradients in the same order, as ``score_outer_product`` or ``adjust`` returns it.
        noise: standard deviation of one pixel's inverse depth, 1/m.
        heading_rad: heading of the view in the map frame, rad.
        model: ``OF_POINTS`` or ``OF_RAYS``, as the pose was found.
        stability: of a pose of the ray adjustment; None for a pose of the points.
    """
    ratio = float(np.clip(noise, LEAST, MOST)) / AT_NOISE
    prior = np.diag(_PRIOR_SIGMA**-2.0)
    bread = np.linalg.inv(information + prior)
    parts = model.shared**2 * bread @ scatter @ bread
    if model.independent > 0:
        parts += np.linalg.inv(information / (model.independent * ratio**model.independent_power) ** 2 + prior)
    to_map = np.kron(np.eye(2), rotation_z(heading_rad))
    stretch = to_map @ np.diag(np.array(model.axes) * ratio ** np.array(model.axes_power)) @ to_map.T
    pose = stretch @ parts[:6, :6] @ stretch
    if stability is not None:
        pose += model.restarts**2 * stability.restarts + model.shift**2 * np.outer(stability.shift, stability.shift)
        pose *= _misfit_scale(model, variance_inflation(information, scatter), stability) ** 2
    floor = np.array([*model.floor[:3], *np.deg2rad(model.floor[3:])])
    symmetric: Float64[NDArray[np.float64], "6 6"] = 0.5 * (pose + pose.T) + np.diag(floor**2)
    return symmetric


def _misfit_scale(model: CovarianceModel, inflation: float, stability: Stability) -> float:
    """Return the factor of the standard deviations for a misfit of image and map; 1 at its usual size."""
    misfit = np.array([np.log(inflation), 1.0 - stability.mapped_inliers, stability.along_residual])
    exponent = float((misfit - model.usual) @ model.misfit)
    return float(np.exp(np.clip(exponent, -_MOST_MISFIT, _MOST_MISFIT)))


def score_outer_product(
    cloud: Surfels, points: QueryPoints, found: Registered, settings: RegistrationSettings
) -> Float64[NDArray[np.float64], "8 8"]:
    """Sum the outer products of the patches' gradients at a registered pose, scaled up for few patches.

    White, Econometrica 48, 1980; Liang and Zeger, Biometrika 73, 1986. If points were independent and their variances right, the sum
    would be the information. The factor for few patches is n / (n - 8).

    Args:
        cloud: surfels around the pose.
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
    each = gradients(cloud.pieces, weighed, state, settings.fine, patches(points.ray))
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
