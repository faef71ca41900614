"""Check that the depth image shows the ground, and that the camera is mounted as the service assumes."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64
from numpy.typing import NDArray

from service.doctor.finding import Finding
from service.geometry.camera import PinholeCamera
from service.imaging.level import NEAR_M, REACH_M, STEP_PIXELS, CameraLevel, level_camera

#: Height above the ground that the service takes as usual (``service.imaging.query_view``), metres.
ASSUMED_HEIGHT_M = 1.5
#: Heights from which a fit starts, metres, and pitches (down is positive) where no gravity is given, degrees. ``level_camera`` finds only
#: planes near its prior.
HEIGHTS_M = (0.2, 0.35, 0.6, 1.0, 1.5, 2.0, 2.7, 3.6)
PITCHES_DEG = (-30.0, -20.0, -10.0, 0.0, 10.0, 20.0, 30.0)
#: Usual heights of the camera, metres, and the largest tilt, degrees.
LEAST_HEIGHT_M, MOST_HEIGHT_M = 0.5, 2.5
MOST_TILT_DEG = 15.0
#: A ground point lies so near to the plane: constant part (m), and part per metre of distance.
NEAR_PLANE_M, NEAR_PLANE_PER_M = 0.05, 0.01
#: Share of the measured pixels within reach that must lie on the ground.
LEAST_SHARE = 0.1
#: Another plane than that of the service counts only if it has so many times as many points.
BETTER = 1.25
#: Largest difference between the height of the plane and the height that the service finds from its own prior, metres.
AGREE_M = 0.2


@dataclass(frozen=True, slots=True)
class Ground:
    """The plane that most pixels of the lower part of the view lie on.

    Attributes:
        share: share of the measured pixels within reach that lie on the plane.
        height_m: height of the camera above the plane, metres.
        pitch_deg: how far the optical axis points below the horizon, degrees.
        roll_deg: rotation about the optical axis, degrees; positive if the right side of the image is lower.
        found_by_service_m: height of the camera that the service finds, metres.
    """

    share: float
    height_m: float
    pitch_deg: float
    roll_deg: float
    found_by_service_m: float


def ground_of(
    depth_m: Float32[NDArray[np.float32], "H W"],
    camera: PinholeCamera,
    down_camera: Float64[NDArray[np.float64], "3"] | None,
) -> Ground:
    """Find the ground from many priors, and compare with what the service finds from its own prior.

    Args:
        depth_m: z, metres, 0 where nothing was measured.
        camera: intrinsics, pixels, at any size with the same aspect ratio.
        down_camera: direction of gravity in the camera frame, if known.
    """
    points = _points(depth_m, camera)
    own = level_camera(depth_m, camera, down_camera=down_camera, nominal_height_m=ASSUMED_HEIGHT_M)
    own_share = _share_on(points, own)
    best, best_share = own, own_share
    for down in [down_camera] if down_camera is not None else [_down_of(pitch) for pitch in PITCHES_DEG]:
        for height_m in HEIGHTS_M:
            found = level_camera(depth_m, camera, down_camera=down, nominal_height_m=height_m)
            share = _share_on(points, found)
            if share > max(best_share, BETTER * own_share) and found.height_m > 0:
                best, best_share = found, share
    R = best.R_level_camera  # its third row is the direction up, in the camera frame
    return Ground(
        share=best_share,
        height_m=best.height_m,
        pitch_deg=float(np.rad2deg(np.arcsin(np.clip(-R[2, 2], -1, 1)))),
        roll_deg=float(np.rad2deg(np.arctan2(-R[2, 0], -R[2, 1]))),
        found_by_service_m=own.height_m,
    )


def _down_of(pitch_deg: float) -> Float64[NDArray[np.float64], "3"]:
    pitch = np.deg2rad(pitch_deg)
    return np.array([0.0, np.cos(pitch), np.sin(pitch)])


def _points(depth_m: Float32[NDArray[np.float32], "H W"], camera: PinholeCamera) -> Float64[NDArray[np.float64], "N 3"]:
    """Measured points within reach in the camera frame, as many as the fit reads."""
    step = max(1, depth_m.shape[1] // STEP_PIXELS)
    z = depth_m[::step, ::step].astype(np.float64)
    rays = camera.scaled_to(depth_m.shape[1], depth_m.shape[0]).rays_of_pixels()[::step, ::step]
    good = (z >= NEAR_M) & (z <= REACH_M)
    points: Float64[NDArray[np.float64], "N 3"] = rays[good] * z[good][:, None]
    return points


def _share_on(points: Float64[NDArray[np.float64], "N 3"], found: CameraLevel) -> float:
    if not len(points):
        return 0.0
    level = points @ found.R_level_camera.T
    band = NEAR_PLANE_M + NEAR_PLANE_PER_M * np.hypot(level[:, 0], level[:, 1])
    return float(np.mean(np.abs(level[:, 2] + found.height_m) <= band))


def check_ground(ground: Ground) -> Finding:
    """Check that the ground is seen, and that height and tilt of the camera are usual.

    Args:
        ground: as ``ground_of`` found it.
    """
    check = "camera height"
    if ground.share < LEAST_SHARE:
        return Finding(
            check, "warning", f"no ground is seen: {ground.share:.0%} of the pixels between {NEAR_M:g} and {REACH_M:g} m lie on one plane "
            "below the camera",
            f"the service then assumes a level camera {ASSUMED_HEIGHT_M:g} m above the ground; let the image show the ground, and send "
            "gravity",
        )  # fmt: skip
    text = (
        f"{ground.height_m:.2f} m above the ground, {abs(ground.pitch_deg):.0f} degrees {'down' if ground.pitch_deg >= 0 else 'up'}, "
        f"rolled by {abs(ground.roll_deg):.0f} degrees"
    )
    if not LEAST_HEIGHT_M <= ground.height_m <= MOST_HEIGHT_M:
        return Finding(
            check, "warning", text,
            f"usual are {LEAST_HEIGHT_M:g} to {MOST_HEIGHT_M:g} m, and the service assumes about {ASSUMED_HEIGHT_M:g} m: mount the camera "
            f"so; if it is mounted so, depth.scale_m is off by a factor of about {ASSUMED_HEIGHT_M / ground.height_m:.2g}, or fy is wrong",
        )  # fmt: skip
    if max(abs(ground.pitch_deg), abs(ground.roll_deg)) > MOST_TILT_DEG:
        return Finding(
            check, "warning", f"{text}: more than {MOST_TILT_DEG:g} degrees off level",
            "mount the camera more level, and send gravity in every request (camera frame: x right, y down, z forward)",
        )  # fmt: skip
    if abs(ground.height_m - ground.found_by_service_m) > AGREE_M:
        return Finding(
            check, "warning", f"{text}, but the service takes it for {ground.found_by_service_m:.2f} m",
            f"the service assumes a level camera about {ASSUMED_HEIGHT_M:g} m above the ground: mount the camera so, or send gravity",
        )  # fmt: skip
    return Finding(check, "ok", text)
