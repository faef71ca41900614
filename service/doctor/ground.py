"""Check that the depth image shows the ground, and that the service finds the height and tilt of the camera."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64
from numpy.typing import NDArray

from service.doctor.finding import Finding
from service.geometry.camera import PinholeCamera
from service.imaging.level import (
    HEIGHT_RANGE_M,
    NEAR_M,
    REACH_M,
    STEP_PIXELS,
    USUAL_HEIGHT_M,
    CameraLevel,
    GivenHeight,
    HeightOrigin,
    level_camera,
    level_query,
)

#: Heights from which a fit starts, metres, and pitches (down is positive) where no gravity is given, degrees. ``level_camera`` finds only
#: planes near its prior.
HEIGHTS_M = (0.1, 0.2, 0.35, 0.6, 1.0, 1.5, 2.0, 2.7, 3.6, 5.0, 7.0)
PITCHES_DEG = (-30.0, -20.0, -10.0, 0.0, 10.0, 20.0, 30.0)
#: Usual heights of a camera, metres. Another height may also come from a wrong depth unit or focal length.
USUAL_RANGE_M = (0.5, 2.5)
#: Largest tilt, degrees.
MOST_TILT_DEG = 15.0
#: A ground point lies so near to the plane: constant part (m), and part per metre of distance.
NEAR_PLANE_M, NEAR_PLANE_PER_M = 0.05, 0.01
#: Share of the measured pixels within reach that must lie on the ground.
LEAST_SHARE = 0.1
#: Another plane than that of the service counts only if it has so many times as many points.
BETTER = 1.25
#: Largest difference between the height of the plane and the height that the service finds, or that the request gives, metres.
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
        origin: where the service takes this height from.
        given_m: height that the request gives, metres; None if it gives none.
    """

    share: float
    height_m: float
    pitch_deg: float
    roll_deg: float
    found_by_service_m: float
    origin: HeightOrigin = "estimated"
    given_m: float | None = None


def ground_of(
    depth_m: Float32[NDArray[np.float32], "H W"],
    camera: PinholeCamera,
    down_camera: Float64[NDArray[np.float64], "3"] | None,
    given: GivenHeight | None = None,
) -> Ground:
    """Find the ground from many priors, and compare with what the service finds.

    Args:
        depth_m: z, metres, 0 where nothing was measured.
        camera: intrinsics, pixels, at any size with the same aspect ratio.
        down_camera: direction of gravity in the camera frame, if known.
        given: height of the camera that the request gives; None if it gives none.
    """
    points = _points(depth_m, camera)
    own, origin = level_query(depth_m, camera, down_camera=down_camera, given=given)
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
        origin=origin,
        given_m=None if given is None else given.height_m,
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
    """Check that the ground is seen, that the service finds the height of the camera, and that its tilt is small.

    Args:
        ground: as ``ground_of`` found it.
    """
    check, (least_m, most_m) = "camera height", HEIGHT_RANGE_M
    if ground.share < LEAST_SHARE:
        taken_m = USUAL_HEIGHT_M if ground.given_m is None else ground.given_m
        sent = ", and send camera.height_m and gravity" if ground.given_m is None else ", and send gravity"
        return Finding(
            check,
            "warning",
            f"no ground is visible: {ground.share:.0%} of the pixels between {NEAR_M:g} and {REACH_M:g} m lie on one "
            "plane below the camera",
            f"the service then assumes a level camera {taken_m:g} m above the ground; let the image show the ground{sent}",
        )
    text = (
        f"{ground.height_m:.2f} m above the ground, {abs(ground.pitch_deg):.0f} degrees {'down' if ground.pitch_deg >= 0 else 'up'}, "
        f"rolled by {abs(ground.roll_deg):.0f} degrees"
    )
    if ground.given_m is not None and abs(ground.height_m - ground.given_m) > AGREE_M:
        return Finding(
            check,
            "warning",
            f"{text}, but the request gives {ground.given_m:g} m",
            "measure the height of the camera's centre above the ground again; if it is right, depth.scale_m or fy is wrong",
        )
    if ground.given_m is None and not least_m <= ground.height_m <= most_m:
        return Finding(
            check,
            "warning",
            text,
            f"the service finds heights from {least_m:g} to {most_m:g} m: send camera.height_m; if the camera is not mounted so, "
            "depth.scale_m or fy is wrong",
        )
    if max(abs(ground.pitch_deg), abs(ground.roll_deg)) > MOST_TILT_DEG:
        return Finding(
            check,
            "warning",
            f"{text}: more than {MOST_TILT_DEG:g} degrees off level",
            "mount the camera more level, and send gravity in every request (camera frame: x right, y down, z forward)",
        )
    if ground.origin == "assumed":
        return Finding(
            check,
            "warning",
            f"{text}, but the service does not accept this plane as ground and assumes {ground.found_by_service_m:.2f} m",
            "send camera.height_m and gravity in every request, or let the image show more of the ground",
        )
    if abs(ground.height_m - ground.found_by_service_m) > AGREE_M:
        return Finding(
            check,
            "warning",
            f"{text}, but the service uses {ground.found_by_service_m:.2f} m ({ground.origin})",
            "send camera.height_m and gravity in every request",
        )
    if ground.given_m is None and not USUAL_RANGE_M[0] <= ground.height_m <= USUAL_RANGE_M[1]:
        return Finding(
            check,
            "ok",
            f"{text}; the service finds this height",
            "if the camera is not mounted so, depth.scale_m or fy is wrong; if it is, camera.height_m makes the height certain",
        )
    return Finding(check, "ok", text)
