"""Make a scan from a depth image, for recordings without a LiDAR. The map then shows only what the camera saw."""

import numpy as np
from jaxtyping import Float32
from numpy.typing import NDArray

from model_training.importing.recording import RecordedPicture, RecordedScan
from service.geometry.rigid import transform_points

#: One of this many pixels per row and per column becomes a point.
EVERY_PX = 4


def scan_from_depth(picture: RecordedPicture) -> RecordedScan | None:
    """Convert a rectified image pair to a scan in the vehicle frame; its intensity is the grey level, 0..1.

    Args:
        picture: rectified image with depth.

    Returns:
        The scan; None if no pixel has depth.
    """
    if picture.depth is None:
        return None
    metres = np.asarray(picture.depth, np.float32) * (
        picture.depth_scale_m if picture.depth.dtype == np.uint16 else 1.0
    )
    z: Float32[NDArray[np.float32], "h w"] = metres[::EVERY_PX, ::EVERY_PX]
    camera = picture.camera
    v, u = np.mgrid[0 : camera.height : EVERY_PX, 0 : camera.width : EVERY_PX]
    measured = np.isfinite(z) & (z > 0)
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
    points = transform_points(picture.T_vehicle_camera, (rays * z[..., None])[measured].astype(np.float64))
    if not len(points):
        return None
    grey = picture.rgb[::EVERY_PX, ::EVERY_PX].mean(axis=-1)[measured] / 255.0
    return RecordedScan(picture.name, picture.stamp_s, np.c_[points, grey].astype(np.float32))
