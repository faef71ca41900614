"""What of a LiDAR's panorama a tower is shown: all of it, or what a camera at the place would see of it.

The second follows ModaLink (field of view first, then one image plane for both sides): here the LiDAR's ranges are drawn on
the camera's own picture plane, for a fan of headings at each place, since the camera's heading is not known.
"""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from model_training.baselines.dual.pictures import Sweeps, lidar_planes
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import R_BODY_OPTICAL
from service.imaging.view_grid import ViewGrid


class LidarViews(Protocol):
    """Cuts views out of panoramas. ``headings``: views of each place; ``size`` (height, width) of a view."""

    headings: int
    size: tuple[int, int]

    def planes(self, sweeps: Sweeps, rows: NDArray[np.int64], heading_rad: NDArray[np.float64]) -> Tensor:
        """Planes (B, 3, height, width) of views of ``rows`` (B), each along a heading (B) against its panorama's x."""


class WholePanorama:
    """All round, whatever the heading; every second column."""

    headings = 1

    def __init__(self, grid: ViewGrid) -> None:
        self.size = (grid.rows, grid.around // 2)

    def planes(self, sweeps: Sweeps, rows: NDArray[np.int64], heading_rad: NDArray[np.float64]) -> Tensor:  # noqa: ARG002 (none is needed)
        """See ``LidarViews``."""
        return lidar_planes(sweeps.panoramas[rows][:, :, ::2], sweeps.intensities[rows][:, :, ::2])


class CameraField:
    """A level camera's picture plane: z, metres, of the panorama's cell that lies nearest to each pixel's ray."""

    headings = 24

    def __init__(self, camera: PinholeCamera, grid: ViewGrid) -> None:
        self.size = (camera.height, camera.width)
        rays = camera.rays_of_pixels() @ R_BODY_OPTICAL.T  # x along the heading is 1
        elevation = np.arctan2(rays[..., 2], np.hypot(rays[..., 0], rays[..., 1]))
        top, bottom = np.deg2rad(grid.elevation_top_deg), np.deg2rad(grid.elevation_bottom_deg)
        row = np.rint((top - elevation) / (top - bottom) * (grid.rows - 1)).astype(np.int64)
        self._inside = (row >= 0) & (row < grid.rows)
        self._row = row.clip(0, grid.rows - 1)
        self._column = (np.arctan2(rays[..., 1], rays[..., 0]) + np.pi) / (2 * np.pi) * grid.around
        self._z_of_range = (1 / np.linalg.norm(rays, axis=-1)).astype(np.float16)
        self._around = grid.around

    def planes(self, sweeps: Sweeps, rows: NDArray[np.int64], heading_rad: NDArray[np.float64]) -> Tensor:
        """See ``LidarViews``."""
        turned = heading_rad[:, None, None] * (self._around / (2 * np.pi))
        column = np.rint(self._column + turned).astype(np.int64) % self._around
        cells = (rows[:, None, None], self._row, column)
        return lidar_planes(
            sweeps.panoramas[cells] * (self._z_of_range * self._inside), sweeps.intensities[cells] * self._inside
        )


def fan(views: LidarViews) -> NDArray[np.float64]:
    """Headings of a place's views, radians against the panorama's x."""
    return np.linspace(0.0, 2 * np.pi, views.headings, endpoint=False)
