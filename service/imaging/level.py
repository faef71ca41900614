"""Level a depth image: find the vertical axis and the height of the camera above the ground.

Map views are level with the ground under the vehicle, so query views must be level too. A depth image shows little ground, and a
stereo depth image shows it with much noise. So the ground plane is fitted under a prior: the direction of gravity or of the
mounting, and the height of the camera (decisions 0005 and 0009). The height is given, or the usual one. If the plane of the
usual height does not fit the image, other heights are tried (decision 0145).

Speed: a fit in ``level.c`` takes a twelfth of the time of NumPy (26 November 2026, decision 0148).
"""

import ctypes
from ctypes import POINTER, Structure, byref, c_double, c_int64, c_void_p
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float32, Float64
from numpy.typing import NDArray

from service.compiled import load
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import R_BODY_OPTICAL, Rotation, rotation_taking
from service.imaging.as_c import CPicture, c_picture

#: Library that the build compiles from ``level.c``.
LIBRARY = Path(__file__).with_name("_level.so")
#: The fit reads about this many columns of the image.
STEP_PIXELS = 80
#: Largest depth z of a ground point, metres.
REACH_M = 14.0
#: Smallest depth z of a ground point, metres.
NEAR_M = 1.0
#: Standard deviation of the prior of each slope of the plane (decision 0009).
TILT_PRIOR_RAD = np.deg2rad(1.5)
#: Usual height of a camera above the ground, and the standard deviation of this prior (decision 0009).
USUAL_HEIGHT_M, HEIGHT_PRIOR_M = 1.5, 0.12
#: Heights that are tried if the usual one does not fit. A fit finds planes near its prior only. An estimate lies in ``HEIGHT_RANGE_M``.
HEIGHTS_M, HEIGHT_RANGE_M = (0.2, 0.35, 0.6, 1.0, 1.5, 2.2, 3.2), (0.15, 4.0)
#: A fit is repeated from its own result this often, so that the prior of the height does not bias it.
REPEATS = 3
#: A plane is the ground if at least this share of the measured pixels lies on it, and at most that share below it.
LEAST_ON, MOST_BELOW = 0.1, 0.02
#: Pitches that are tried as well if no plane of a level camera holds ``SURE_ON`` of the measured pixels, rad; positive is downwards. A fit
#: finds planes within about 4 degrees of its prior. A tilted plane must hold ``LEAST_TILTED_ON``, because a camera is seldom tilted.
PITCHES_RAD = np.deg2rad([-21.0, -14.0, -7.0, 7.0, 14.0, 21.0])
SURE_ON, LEAST_TILTED_ON = 0.45, 0.35
#: The usual height counts as fitting if its plane differs by less than this, metres. Beyond it the prior would bias the result.
USUAL_WITHIN_M = 0.1
#: A focal length that is off by a factor of two makes the estimated height wrong by the inverse factor. So an estimate whose ratio to the
#: usual height lies in one of these ranges may have this cause.
SUSPICIOUS_RATIOS = ((0.4, 0.6), (1.7, 2.4))
#: Standard deviation of one ground point across the plane: constant part (m), and part per metre of horizontal distance.
NOISE_M, NOISE_PER_M = 0.08, 0.01
#: Number of neighbouring points with correlated errors. The fit counts so many points as one (decision 0081).
CORRELATED = 15.0
#: Inlier band around the plane of the previous round, one row (a, b, c) per round. At the horizontal distance r, a point may lie
#: a + b * r below the plane and c * (a + b * r) above it (metres). The last bands are narrow, and narrower above. Otherwise
#: pavements would tilt the plane by half a degree, because they lie a kerb above the road and further ahead (decision 0081).
BANDS = np.array(
    [
        (0.5, 0.08, 1.0),
        (0.35, 0.05, 1.0),
        (0.25, 0.03, 1.0),
        (0.11, 0.016, 0.7),
        (0.08, 0.012, 0.7),
        (0.06, 0.008, 0.7),
        (0.06, 0.008, 0.7),
    ]
)


@dataclass(frozen=True, slots=True)
class CameraLevel:
    """Orientation and height of a camera relative to the ground.

    Attributes:
        R_level_camera: rotation from the optical frame to the level frame (x along the horizontal part of the optical axis,
            z up along the normal of the ground).
        height_m: height of the camera above the ground, metres.
        on_share: share of the measured pixels within reach that lie on the fitted plane.
        below_share: share of these pixels that lie clearly below the plane.
    """

    R_level_camera: Rotation
    height_m: float
    on_share: float = 0.0
    below_share: float = 0.0

    @property
    def is_ground(self) -> bool:
        """Whether the fitted plane can be the ground: enough pixels on it, hardly any below it."""
        return self.on_share >= LEAST_ON and self.below_share <= MOST_BELOW


#: Where the height of a camera comes from: the request, the image, or neither of them.
HeightOrigin = Literal["given", "estimated", "assumed"]


@dataclass(frozen=True, slots=True)
class GivenHeight:
    """Height of the camera above the ground that the caller knows.

    Attributes:
        height_m: height of the camera's centre above the ground, metres.
        std_m: its standard deviation, metres.
    """

    height_m: float
    std_m: float


def is_suspicious_height(height_m: float, origin: str) -> bool:
    """Return whether an estimated height may come from a focal length that is off by a factor of two.

    Args:
        height_m: height of the camera above the ground, metres.
        origin: origin of this height, as ``level_query`` returns it.
    """
    ratio = height_m / USUAL_HEIGHT_M
    return origin == "estimated" and any(least <= ratio <= most for least, most in SUSPICIOUS_RATIOS)


def nominal_level(down_camera: Float64[NDArray[np.float64], "3"] | None) -> Rotation:
    """Compute ``R_level_camera`` from gravity, or for a camera that looks straight ahead.

    Args:
        down_camera: direction of gravity in the camera frame, any length, not parallel to the optical axis. None: the camera is
            taken as level.
    """
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
    height_std_m: float = HEIGHT_PRIOR_M,
) -> CameraLevel:
    """Fit the ground plane of a depth image under a prior and level the camera with it.

    Args:
        depth_m: z, metres, 0 where nothing was measured. It has the aspect ratio of the camera.
        camera: intrinsics, pixels, at any size with the same aspect ratio.
        down_camera: direction of gravity in the camera frame, any length, if an IMU measured it. Else None.
        nominal_height_m: mean of the prior of the camera's height above the ground, metres.
        height_std_m: standard deviation of this prior, metres.

    Returns:
        Level of the camera. Without visible ground, this is the prior.
    """
    R = nominal_level(down_camera)
    slope_x, slope_y, ground, measured, on, below = _fit_ground(depth_m, camera, R, nominal_height_m, height_std_m)
    normal = np.array([-slope_x, -slope_y, 1.0])
    normal /= np.linalg.norm(normal)
    R_level = rotation_taking(normal, np.array([0.0, 0.0, 1.0])) @ R
    # The tilt rotates the horizontal part of the optical axis a little away from x. The heading of a view is that of the optical
    # axis, so rotate the axis back to x.
    axis = R_level[:, 2]
    flat = float(np.hypot(axis[0], axis[1]))
    if flat > 1e-6:
        turn = np.array([[axis[0], axis[1], 0.0], [-axis[1], axis[0], 0.0], [0.0, 0.0, flat]]) / flat
        R_level = turn @ R_level
    pixels = max(measured, 1.0)
    return CameraLevel(R_level, float(-ground * normal[2]), on / pixels, below / pixels)


def level_query(
    depth_m: Float32[NDArray[np.float32], "H W"],
    camera: PinholeCamera,
    *,
    down_camera: Float64[NDArray[np.float64], "3"] | None = None,
    given: GivenHeight | None = None,
) -> tuple[CameraLevel, HeightOrigin]:
    """Level the camera of a query, and find its height if it is not given.

    The usual height is tried first. If its plane is not the ground, or lies so far from it that the prior would bias the result,
    other heights are tried. The plane with the most pixels counts, if it can be the ground. If no plane holds many pixels and nobody
    knows gravity, the camera may be tilted, and pitches up to 25 degrees are tried too.

    Args:
        depth_m: z, metres, 0 where nothing was measured. It has the aspect ratio of the camera.
        camera: intrinsics, pixels, at any size with the same aspect ratio.
        down_camera: direction of gravity in the camera frame, any length, if an IMU measured it. Else None.
        given: height of the camera, if the caller knows it.

    Returns:
        Level of the camera, and the origin of its height. "assumed": the image shows no ground, so the usual height counts.
    """
    may_be_tilted = down_camera is None
    if given is not None:
        level = level_camera(
            depth_m, camera, down_camera=down_camera, nominal_height_m=given.height_m, height_std_m=given.std_m
        )
        if may_be_tilted and not _is_sure(level):
            for best in _tilted_levels(depth_m, camera, (given.height_m,), given.std_m)[:1]:
                if best.on_share <= level.on_share:
                    break
                down = -best.R_level_camera[2]
                level = level_camera(
                    depth_m, camera, down_camera=down, nominal_height_m=given.height_m, height_std_m=given.std_m
                )
        return level, "given"
    usual = level_camera(depth_m, camera, down_camera=down_camera, nominal_height_m=USUAL_HEIGHT_M)
    if usual.is_ground and abs(usual.height_m - USUAL_HEIGHT_M) < USUAL_WITHIN_M:
        return usual, "estimated"
    found = [
        (level_camera(depth_m, camera, down_camera=down_camera, nominal_height_m=height_m), False)
        for height_m in HEIGHTS_M
    ]
    if may_be_tilted and not any(_is_sure(level) for level, _ in found):
        found += [(level, True) for level in _tilted_levels(depth_m, camera, HEIGHTS_M, HEIGHT_PRIOR_M)]
    grounds = [each for each in found if each[0].is_ground]
    for best, is_tilted in sorted(grounds, key=lambda each: -each[0].on_share):
        level = best
        for _ in range(REPEATS):
            down = -level.R_level_camera[2] if is_tilted else down_camera
            level = level_camera(depth_m, camera, down_camera=down, nominal_height_m=level.height_m)
        if level.is_ground and HEIGHT_RANGE_M[0] <= level.height_m <= HEIGHT_RANGE_M[1]:
            return level, "estimated"
    return usual, "assumed"


def _is_sure(level: CameraLevel) -> bool:
    """Return whether so many pixels lie on the plane that other tilts need not be tried."""
    return level.is_ground and level.on_share >= SURE_ON


def _tilted_levels(
    depth_m: Float32[NDArray[np.float32], "H W"], camera: PinholeCamera, heights_m: tuple[float, ...], std_m: float
) -> list[CameraLevel]:
    """Return the levels of a tilted camera whose plane can be the ground, the one with most pixels on it first."""
    found = [
        level_camera(
            depth_m,
            camera,
            down_camera=np.array([0.0, np.cos(pitch), np.sin(pitch)]),
            nominal_height_m=height_m,
            height_std_m=std_m,
        )
        for pitch in PITCHES_RAD
        for height_m in heights_m
    ]
    grounds = (level for level in found if level.is_ground and level.on_share >= LEAST_TILTED_ON)
    return sorted(grounds, key=lambda level: -level.on_share)


class _Ground(Structure):
    _fields_ = [
        (name, c_double)
        for name in (
            "near_m",
            "reach_m",
            "below_m",
            "height_m",
            "tilt_prior",
            "height_prior_m",
            "noise_m",
            "noise_per_m",
            "correlated",
        )
    ]


#: Ground point in the work buffer of the fit: position in the nominal level frame (m), horizontal distance (m), weight (1/m^2).
_POINT = np.dtype([(name, "<f8") for name in ("x", "y", "z", "reach", "weight")])


@cache
def _library() -> ctypes.CDLL:
    library = load(LIBRARY, {"Picture": CPicture, "Ground": _Ground, "Point": _POINT})
    library.streetfix_fit_ground.argtypes = [
        c_void_p,
        POINTER(CPicture),
        c_int64,
        c_void_p,
        POINTER(_Ground),
        c_void_p,
        c_int64,
        c_void_p,
        c_void_p,
    ]
    library.streetfix_fit_ground.restype = None
    return library


def _fit_ground(
    depth_m: Float32[NDArray[np.float32], "H W"],
    camera: PinholeCamera,
    R: Rotation,
    height_m: float,
    height_std_m: float,
) -> tuple[float, ...]:
    """Fit slopes a, b and offset c (m) of the ground z = a x + b y + c in the nominal level frame.

    The prior is a = b = 0 and c = -height_m. It is the result if the image shows no ground. The result ends with the number of
    measured pixels within reach, of those on the plane, and of those clearly below it.
    """
    depth_m, R = np.ascontiguousarray(depth_m, np.float32), np.ascontiguousarray(R, np.float64)
    height, width = depth_m.shape
    if R.shape != (3, 3):
        raise ValueError(f"R {R.shape} must be a rotation matrix (3, 3)")
    step = max(1, width // STEP_PIXELS)
    found, points = np.empty(6), np.empty(-(-height // step) * -(-width // step), _POINT)
    _library().streetfix_fit_ground(
        depth_m.ctypes.data,
        byref(c_picture(camera, depth_m)),
        step,
        R.ctypes.data,
        byref(
            _Ground(
                NEAR_M,
                REACH_M,
                0.3 * height_m,
                height_m,
                TILT_PRIOR_RAD,
                height_std_m,
                NOISE_M,
                NOISE_PER_M,
                CORRELATED,
            )
        ),
        BANDS.ctypes.data,
        len(BANDS),
        points.ctypes.data,
        found.ctypes.data,
    )
    return tuple(found.tolist())
