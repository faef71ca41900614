"""How much the patches of a picture disagree about its pose: the middle of a sandwich estimate of covariance."""

import numpy as np
from jaxtyping import Float32, Float64, Int32
from numpy.typing import NDArray

from service.registration.kernel import STATE, UNKNOWNS, QueryPoints, pulls
from service.registration.register import Registered, RegistrationSettings
from service.registration.surfel_map import SurfelMap

#: Width of a patch. Within one, points err together: noise of matching hangs together over 16 to 60 pixels of 640, a parked car
#: that was not there is as wide. Of 0.05, 0.1, 0.2 and 0.3, watch cities.
PATCH_RAD = 0.2
#: Of a direction's information, every unknown in units of its own; less is next to none (a wall's distance against the scale: 4e-6).
_TOLD = 1e-4
_LEAST = 1e-6  # disagreement; its logarithm is evidence


def scatter_of(
    cloud: SurfelMap, points: QueryPoints, found: Registered, settings: RegistrationSettings
) -> Float64[NDArray[np.float64], "8 8"]:
    """Sum over patches of the outer product of their pulls on a registered pose, scaled up for few patches.

    White, Econometrica 48, 1980; Liang and Zeger, Biometrika 73, 1986. Were points independent and their variances right, this
    would be the information itself.

    Args:
        cloud: the map's.
        points: that were registered.
        found: the pose.
        settings: that it was registered with.
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
    """The residual of a pose: mean ratio of ``scatter_of`` to the points' information; 1 where their noise explains it all.

    In directions that no point tells anything of there is nothing to disagree about, so they do not count.
    """
    sizes = np.sqrt(np.maximum(np.diag(information), 1e-300))
    strength, axes = np.linalg.eigh(information / np.outer(sizes, sizes))
    told = strength > _TOLD
    if not told.any():
        return 1.0
    seen = np.einsum("ik,ij,jk->k", axes[:, told], scatter / np.outer(sizes, sizes), axes[:, told])
    return max(float(np.mean(seen / strength[told])), _LEAST)


def patches(ray: Float32[NDArray[np.float32], "n 3"]) -> Int32[NDArray[np.int32], " n"]:
    """Number of the patch that each ray lies in, from 0 without gaps."""
    azimuth, elevation = np.arctan2(ray[:, 1], ray[:, 0]), np.arcsin(np.clip(ray[:, 2], -1, 1))
    cells = np.floor(azimuth / PATCH_RAD).astype(np.int64) * 64 + np.floor(elevation / PATCH_RAD).astype(np.int64)
    return np.unique(cells, return_inverse=True)[1].astype(np.int32)
