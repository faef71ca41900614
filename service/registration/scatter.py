"""Disagreement of the patches of an image about its pose: the middle factor of a sandwich estimate of covariance."""

import numpy as np
from jaxtyping import Float32, Float64, Int32
from numpy.typing import NDArray

from service.registration.kernel import STATE, UNKNOWNS, QueryPoints, pulls
from service.registration.register import Registered, RegistrationSettings
from service.registration.surfel_map import SurfelMap

#: Width of a patch, rad. The points of a patch share errors. Matching errors are correlated over 16 to 60 of 640 pixels. A parked car
#: that the survey did not see is as wide. Chosen among 0.05, 0.1, 0.2 and 0.3 rad on validation cities (decision 0037).
PATCH_RAD = 0.2
#: Least eigenvalue of the normalised information (unit diagonal) of an observable direction. For comparison: a wall's distance against
#: the scale has 4e-6.
_TOLD = 1e-4
#: Least disagreement. Its logarithm is a confidence feature, so it must not be 0.
_LEAST = 1e-6


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
    weighed = points.weighing_at_least(settings.fine_weight)
    each = pulls(cloud.grid, cloud.surfels, weighed, state, settings.fine, patches(points.ray))
    scatter: Float64[NDArray[np.float64], "8 8"] = each.T @ each * (len(each) / max(len(each) - UNKNOWNS, 1))
    return scatter


def disagreement(
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
    told = strength > _TOLD
    if not told.any():
        return 1.0
    seen = np.einsum("ik,ij,jk->k", axes[:, told], scatter / np.outer(sizes, sizes), axes[:, told])
    return max(float(np.mean(seen / strength[told])), _LEAST)


def patches(ray: Float32[NDArray[np.float32], "n 3"]) -> Int32[NDArray[np.int32], " n"]:
    """Assign each ray to a patch; patches are numbered from 0 without gaps.

    Args:
        ray: unit vectors in the level frame.
    """
    azimuth, elevation = np.arctan2(ray[:, 1], ray[:, 0]), np.arcsin(np.clip(ray[:, 2], -1, 1))
    cells = np.floor(azimuth / PATCH_RAD).astype(np.int64) * 64 + np.floor(elevation / PATCH_RAD).astype(np.int64)
    return np.unique(cells, return_inverse=True)[1].astype(np.int32)
