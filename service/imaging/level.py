"""The local level of a depth picture: which way is up, and how high the camera stands.

Map views are level with the ground under the vehicle, so queries must be too. A depth picture shows little ground and
a stereo one shows it badly, so the plane is fitted under a prior (gravity or the mounting, and the usual height).
"""

import ctypes
from ctypes import POINTER, Structure, byref, c_double, c_int64, c_void_p
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64
from numpy.typing import NDArray

from service.compiled import load
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import R_BODY_OPTICAL, Rotation, rotation_taking
from service.imaging.as_c import CPicture, c_picture

LIBRARY = Path(__file__).with_name("_level.so")
STEP_PIXELS = 80  # the picture is read at about this many columns
REACH_M = 14.0
NEAR_M = 1.0
TILT_PRIOR_RAD = np.deg2rad(1.5)
HEIGHT_PRIOR_M = 0.12
NOISE_M, NOISE_PER_M = 0.08, 0.01  # of one ground point, across the plane; more for each metre of its distance
CORRELATED = 15.0  # so many neighbouring points err together: the fit counts them once
#: How far a point may lie from the plane of the round before: metres, metres for each metre of distance, and the share of that which
#: counts above it. The last are narrow, and narrower above: pavements stand a kerb above the road, lie further ahead than it in
#: any picture, and tilt a plane through both by half a degree (decision log).
BANDS = np.array([
    (0.5, 0.08, 1.0), (0.35, 0.05, 1.0), (0.25, 0.03, 1.0), (0.11, 0.016, 0.7), (0.08, 0.012, 0.7), (0.06, 0.008, 0.7), (0.06, 0.008, 0.7),
])  # fmt: skip


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
    slope_x, slope_y, ground = _fit_ground(depth_m, camera, R, nominal_height_m)
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


class _Ground(Structure):
    _fields_ = [(name, c_double) for name in (
        "near_m", "reach_m", "below_m", "height_m", "tilt_prior", "height_prior_m", "noise_m", "noise_per_m", "correlated",
    )]  # fmt: skip


#: Room for one ground point: position in the nominal level frame, horizontal distance (m), weight (1/m^2).
_POINT = np.dtype([(name, "<f8") for name in ("x", "y", "z", "reach", "certainty")])


@cache
def _library() -> ctypes.CDLL:
    library = load(LIBRARY, {"Picture": CPicture, "Ground": _Ground, "Point": _POINT})
    library.streetfix_fit_ground.argtypes = [
        c_void_p, POINTER(CPicture), c_int64, c_void_p, POINTER(_Ground), c_void_p, c_int64, c_void_p, c_void_p,
    ]  # fmt: skip
    library.streetfix_fit_ground.restype = None
    return library


def _fit_ground(
    depth_m: Float32[NDArray[np.float32], "H W"], camera: PinholeCamera, R: Rotation, height_m: float
) -> tuple[float, float, float]:
    """Slopes and offset of z = a x + b y + c near z = -height, level frame R; the prior alone where no ground is seen."""
    depth_m, R = np.ascontiguousarray(depth_m, np.float32), np.ascontiguousarray(R, np.float64)
    height, width = depth_m.shape
    if R.shape != (3, 3):
        raise ValueError(f"R {R.shape} is no rotation")
    step = max(1, width // STEP_PIXELS)
    found, points = np.empty(3), np.empty(-(-height // step) * -(-width // step), _POINT)
    _library().streetfix_fit_ground(
        depth_m.ctypes.data, byref(c_picture(camera, depth_m)), step, R.ctypes.data,
        byref(_Ground(
            NEAR_M, REACH_M, 0.3 * height_m, height_m, TILT_PRIOR_RAD, HEIGHT_PRIOR_M, NOISE_M, NOISE_PER_M, CORRELATED
        )),
        BANDS.ctypes.data, len(BANDS), points.ctypes.data, found.ctypes.data,
    )  # fmt: skip
    return float(found[0]), float(found[1]), float(found[2])
