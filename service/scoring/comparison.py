"""A pose as an image for the verifier: the query's depth and brightness beside the map's, on a level grid of directions.

The grid has fixed directions about the camera's heading, so a pole is as wide for a phone as for a car's camera. All planes are between -1
and 1. Distances appear as inverse depths, and differences in standard deviations and as ratios, so noisy and exact depth look alike where
they agree with the map.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64
from numpy.typing import NDArray

from service.registration.surfel_tiles import Surfels
from service.scoring.measured import MeasuredFrame
from service.scoring.photometry import PhotometrySettings, grey_of, mapped_brightness, seen_by_lens
from service.scoring.ray_image import RayImage, inverse_of

#: Planes of a comparison, in their order.
PLANES = (
    "measured",
    "mapped",
    "inverse_depth",
    "mapped_inverse_depth",
    "difference_sigmas",
    "difference_ratio",
    "height",
    "mapped_height",
    "relative_noise",
    "brightness",
    "mapped_brightness",
    "in_view",
)
#: Rows and columns of the grid, and the angles that it covers to each side of the heading and of the horizon, rad.
ROWS, COLUMNS = 64, 128
AZIMUTH_RAD, ELEVATION_RAD = float(np.deg2rad(48.0)), float(np.deg2rad(24.0))
#: A comparison of one frame.
Comparison = Float32[NDArray[np.float32], "12 64 128"]
#: Inverse depth that fills the scale (1/m), height that fills it (m), and range of the logarithmic brightness.
INVERSE_DEPTH, _HEIGHT_M, _LOG_BRIGHTNESS = 0.25, 10.0, 3.0
#: Standard deviations and ratio at which the differences reach three quarters of their scale (the hyperbolic tangent of 1).
_SIGMAS, _RATIO = 4.0, 1.0 / 3.0
_BELOW = -0.2  # least height, as a share of ``_HEIGHT_M``: noisy depth may lie far below the ground
_FORWARD = 0.1  # least component of a direction along the optical axis


def _directions() -> Float64[NDArray[np.float64], "64 128 3"]:
    """Return the unit vectors of the cells in a level frame whose x axis is the heading of the camera."""
    azimuth = AZIMUTH_RAD - (np.arange(COLUMNS) + 0.5) * (2 * AZIMUTH_RAD / COLUMNS)
    elevation = (ELEVATION_RAD - (np.arange(ROWS) + 0.5) * (2 * ELEVATION_RAD / ROWS))[:, np.newaxis]
    flat = np.cos(elevation)
    return np.stack(
        [flat * np.cos(azimuth), flat * np.sin(azimuth), np.broadcast_to(np.sin(elevation), (ROWS, COLUMNS))], axis=-1
    )


_DIRECTIONS = _directions()


@dataclass(frozen=True, slots=True, eq=False)
class FrameCells:
    """The cells of the grid for one frame: which pixel of its small image shows each direction, and its brightness.

    Attributes:
        pixel: index of the pixel in the flat small image; 0 where there is none.
        in_view: whether a pixel shows the direction.
        brightness: logarithm of the grey level minus its mean over the pixels that the lens saw; 0 where it saw nothing.
    """

    pixel: Int64[NDArray[np.int64], "64 128"]
    in_view: Bool[NDArray[np.bool_], "64 128"]
    brightness: Float32[NDArray[np.float32], "64 128"]

    @classmethod
    def of(cls, measured: MeasuredFrame, settings: PhotometrySettings) -> "FrameCells":
        """Find the pixels of a frame.

        Args:
            measured: the frame.
            settings: settings of the brightness.
        """
        R, camera = measured.frame.R_level_camera, measured.picture.camera
        heading = np.arctan2(R[1, 2], R[0, 2])
        cos, sin = np.cos(heading), np.sin(heading)
        rays = _DIRECTIONS @ (R.T @ np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])).T
        ahead = rays[..., 2] > _FORWARD
        z = np.where(ahead, rays[..., 2], 1.0)
        u = np.rint(rays[..., 0] / z * camera.fx + camera.cx).astype(np.int64)
        v = np.rint(rays[..., 1] / z * camera.fy + camera.cy).astype(np.int64)
        in_view = ahead & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        pixel = np.where(in_view, v * camera.width + u, 0)
        brightness = _brightness_of(measured, settings).ravel()[pixel]
        return cls(pixel, in_view, np.where(in_view, brightness, np.float32(0)))


def _brightness_of(measured: MeasuredFrame, settings: PhotometrySettings) -> Float32[NDArray[np.float32], "H W"]:
    """Return the logarithm of the grey level of each pixel of the small image minus its mean.

    Pixels that the lens did not see are black after the rectification. They do not count in the mean, and their brightness is 0.
    """
    query, camera, covered = measured.frame.query, measured.picture.camera, measured.blocks.covered
    grey = grey_of(query.rgb, camera, covered, settings)
    if query.observed is None:
        return np.asarray(grey - grey.mean())
    seen = seen_by_lens(query.observed, camera, covered)
    mean = grey[seen].mean() if seen.any() else np.float32(0)
    return np.where(seen, grey - mean, np.float32(0))


def comparison_of(
    cells: FrameCells, image: RayImage, surfels: Surfels | None, settings: PhotometrySettings
) -> Comparison:
    """Compute the planes of a comparison, each between -1 and 1; 0 where nothing is known.

    Args:
        cells: cells of the frame.
        image: depth of the frame and of the map along the rays of the frame's small image.
        surfels: surfels of the map, whose brightness is shown; None if brightness is not compared.
        settings: settings of the brightness.
    """
    # Only the pixels of the cells are computed: a tall image has a hundred times as many. The mean of the map's brightness needs all.
    z_m, mapped_m, sigma, climb = (
        each.ravel()[cells.pixel] for each in (image.z_m, image.mapped_m, image.sigma, image.climb)
    )
    inverse, mapped_inverse = inverse_of(z_m), inverse_of(mapped_m)
    known, hit = z_m > 0, mapped_m > 0
    both = known & hit
    sigmas = np.where(both, (inverse - mapped_inverse) / sigma, 0.0)
    ratio = np.where(both, inverse * mapped_m - 1.0, 0.0)
    heights = (
        np.where(seen, np.clip((z * climb + image.camera_m) / _HEIGHT_M, _BELOW, 1.0), 0.0)
        for z, seen in ((z_m, known), (mapped_m, hit))
    )
    if surfels is not None and surfels.has_brightness:
        shown = np.nan_to_num(mapped_brightness(surfels, image.surfel_of, settings).ravel()[cells.pixel])
    else:
        shown = np.zeros(cells.pixel.shape, np.float32)
    planes: Comparison = np.stack(
        [
            known,
            hit,
            np.minimum(inverse / INVERSE_DEPTH, 1.0),
            np.minimum(mapped_inverse / INVERSE_DEPTH, 1.0),
            np.tanh(sigmas / _SIGMAS),
            np.tanh(ratio / _RATIO),
            *heights,
            np.minimum(sigma * mapped_m, 1.0),
            np.clip(cells.brightness / _LOG_BRIGHTNESS, -1.0, 1.0),
            np.clip(shown / _LOG_BRIGHTNESS, -1.0, 1.0),
            cells.in_view,
        ]
    ).astype(np.float32)
    return planes * cells.in_view
