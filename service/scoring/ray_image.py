"""Depth of a frame and of the map along the same rays."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int32
from numpy.typing import NDArray

from service.registration.register import Registered
from service.registration.visibility import SurfelRaycaster
from service.scoring.measured import MeasuredFrame
from service.scoring.structure import LEAST_STRETCH, SURFACE_M


@dataclass(frozen=True, slots=True, eq=False)
class RayImage:
    """Depth of one frame and of the map along the same rays.

    Attributes:
        surfel_of: index of the surfel that each ray meets, -1 for none.
        z_m: measured depth, corrected by the scale and the disparity offset of the pose, m; 0 where nothing was measured.
        mapped_m: depth of the map, m; 0 where the ray meets no surface.
        sigma: standard deviation of the difference of the inverse depths, 1/m.
        climb: height that a ray gains for each metre of depth.
        camera_m: height of the camera above the ground, m.
    """

    surfel_of: Int32[NDArray[np.int32], "H W"]
    z_m: Float64[NDArray[np.float64], "H W"]
    mapped_m: Float64[NDArray[np.float64], "H W"]
    sigma: Float64[NDArray[np.float64], "H W"]
    climb: Float64[NDArray[np.float64], "H W"]
    camera_m: float


def ray_image_of(raycaster: SurfelRaycaster, measured: MeasuredFrame, pose: Registered) -> RayImage:
    """Return the depth of a frame, corrected as its registration estimates, and that of the map along the same rays.

    Args:
        raycaster: ray casting on the map.
        measured: the frame.
        pose: pose of the frame's level frame, with the scale and the disparity offset of its depth.
    """
    frame, picture = measured.frame, measured.picture
    camera, T = picture.camera, frame.pose_of_camera(pose.T_map_level)
    T[:3, 3] -= raycaster.cloud.origin_m
    mapped_m = raycaster.depth(T, camera)
    per_offset = 0.0 if picture.focal_baseline_px_m is None else pose.offset / picture.focal_baseline_px_m
    inverse = picture.inverse.astype(np.float64)
    corrected = np.maximum(inverse + per_offset, LEAST_STRETCH * inverse) / pose.scale
    return RayImage(
        surfel_of=raycaster.intersect(T, camera),
        z_m=inverse_of(np.where(inverse > 0, corrected, 0.0)),
        mapped_m=mapped_m,
        sigma=frame.noise + SURFACE_M * inverse_of(mapped_m) ** 2,
        climb=camera.rays_of_pixels() @ frame.R_level_camera[2],
        camera_m=frame.views.height_m,
    )


def inverse_of(values: Float64[NDArray[np.float64], "H W"]) -> Float64[NDArray[np.float64], "H W"]:
    """Return the inverse of each value, 0 for 0.

    Args:
        values: depths, m, or inverse depths, 1/m; 0 where unknown.
    """
    return np.divide(1.0, values, out=np.zeros(values.shape), where=values > 0)
