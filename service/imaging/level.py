"""The local level of a depth picture: which way is up, and how high the camera stands.

Map views are level with the ground under the vehicle, so queries must be too. A depth picture shows little ground and
a stereo one shows it badly, so the plane is fitted under a prior (gravity or the mounting, and the usual height).
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float32, Float64
from numpy.typing import NDArray

from service.geometry.camera import PinholeCamera
from service.geometry.rigid import R_BODY_OPTICAL, Rotation, rotation_taking

STEP_PIXELS = 80  # the picture is read at about this many columns
REACH_M = 14.0
NEAR_M = 1.0
TILT_PRIOR_RAD = np.deg2rad(1.5)
HEIGHT_PRIOR_M = 0.12
NOISE_M = 0.08  # of one ground point, across the plane
CORRELATED = 50.0  # so many neighbouring points err together: the fit counts them once


@dataclass(frozen=True, slots=True)
class CameraLevel:
    """``R_level_camera``: optical axes into the level frame (x along the axis's horizontal part, z up); height, m."""

    R_level_camera: Rotation
    height_m: float


def nominal_level(down_camera: Float64[NDArray[np.float64], "3"] | None) -> Rotation:
    """R_level_camera from gravity (any length, camera axes), or of a camera that looks straight ahead."""
    if down_camera is None:
        return R_BODY_OPTICAL.copy()
    up = -down_camera / np.linalg.norm(down_camera)
    forward = np.array([0.0, 0.0, 1.0]) - up[2] * up
    forward = forward / np.linalg.norm(forward)
    return np.stack([forward, np.cross(up, forward), up])


def level_camera(
    depth_m: Float32[NDArray[np.float32], "H W"],
    camera: PinholeCamera,
    *,
    down_camera: Float64[NDArray[np.float64], "3"] | None,
    nominal_height_m: float,
) -> CameraLevel:
    """Fit the ground of a depth picture under a prior.

    Args:
        depth_m: z, metres, 0 where nothing was measured; same aspect as the camera.
        camera: intrinsics at the picture's own or another size of the same aspect.
        down_camera: gravity in the camera frame, if an IMU measured it.
        nominal_height_m: usual height of the camera above the ground.
    """
    R = nominal_level(down_camera)
    v, u, rays = _rays(camera, *depth_m.shape)
    z = depth_m[v, u].astype(np.float64)
    measured = (z > NEAR_M) & (z < REACH_M)
    points = (z[measured, None] * rays[measured]) @ R.T
    slope_x, slope_y, ground = _fit_plane(points, nominal_height_m)
    normal = np.array([-slope_x, -slope_y, 1.0])
    normal /= np.linalg.norm(normal)
    R_level = rotation_taking(normal, np.array([0.0, 0.0, 1.0])) @ R
    # Tilting moves the axis's horizontal part a little; the heading of a view is the axis's, so turn it back to x.
    axis = R_level[:, 2]
    flat = float(np.hypot(axis[0], axis[1]))
    if flat > 1e-6:
        turn = np.array([[axis[0], axis[1], 0.0], [-axis[1], axis[0], 0.0], [0.0, 0.0, flat]]) / flat
        R_level = turn @ R_level
    return CameraLevel(R_level, float(-ground * normal[2]))


@lru_cache(maxsize=16)
def _rays(
    camera: PinholeCamera, height: int, width: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], Float64[NDArray[np.float64], "n 3"]]:
    """Rows and columns of the pixels that are read of a picture, and their rays at z = 1; the same for every picture of a camera."""
    own = camera if (camera.height, camera.width) == (height, width) else camera.scaled_to(width, height)
    step = max(1, width // STEP_PIXELS)
    v, u = (each.reshape(-1) for each in np.mgrid[step // 2 : height : step, step // 2 : width : step])
    rays = np.stack([(u - own.cx) / own.fx, (v - own.cy) / own.fy, np.ones(len(u))], axis=1)
    for each in (v, u, rays):
        each.setflags(write=False)
    return v, u, rays


def _fit_plane(points: NDArray[np.float64], height_m: float) -> tuple[float, float, float]:
    """Slopes and offset of z = a x + b y + c near z = -height; the prior alone where no ground is seen."""
    prior = np.diag([1 / TILT_PRIOR_RAD**2, 1 / TILT_PRIOR_RAD**2, 1 / HEIGHT_PRIOR_M**2])
    mean = np.array([0.0, 0.0, -height_m])
    solution = mean
    near = points[points[:, 2] < -0.3 * height_m]
    design, z = np.column_stack([near[:, :2], np.ones(len(near))]), near[:, 2]
    reach = np.hypot(near[:, 0], near[:, 1])
    certainty = 1.0 / ((NOISE_M + 0.01 * reach) ** 2 * CORRELATED)
    for band_m, band_slope in ((0.5, 0.08), (0.35, 0.05), (0.25, 0.03), (0.2, 0.02), (0.2, 0.02)):
        keep = np.abs(z - design @ solution) < band_m + band_slope * reach
        if not keep.any():
            break
        weighted = design * np.where(keep, certainty, 0.0)[:, None]
        information = weighted.T @ design + prior
        solution = np.linalg.solve(information, weighted.T @ z + prior @ mean)
    return float(solution[0]), float(solution[1]), float(solution[2])
