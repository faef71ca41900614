"""Views of a LiDAR panorama for a tower: the whole panorama, or a camera's field of view at the place.

The second kind follows ModaLink: first the field of view, then one image plane for both sides. Here the LiDAR's ranges
are projected onto the camera's image plane. The camera's heading is unknown, so each place has a fan of headings.
"""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from research.baselines.dual.pictures import Sweeps, lidar_planes
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import R_BODY_OPTICAL
from service.imaging.view_grid import ViewGrid


class LidarViews(Protocol):
    """Cuts views out of panoramas.

    Attributes:
        headings: number of views per place.
        size: height and width of a view, cells.
    """

    headings: int
    size: tuple[int, int]

    def planes(self, sweeps: Sweeps, rows: NDArray[np.int64], heading_rad: NDArray[np.float64]) -> Tensor:
        """Return planes (B, 3, height, width) of views.

        Args:
            sweeps: LiDAR frames.
            rows: rows of ``sweeps`` (B,).
            heading_rad: heading of each view (B,) against the panorama's x axis, radians.
        """


class WholePanorama:
    """The whole panorama for any heading, with every second column.

    Args:
        grid: view grid of the panoramas.
    """

    headings = 1

    def __init__(self, grid: ViewGrid) -> None:
        self.size = (grid.rows, grid.around // 2)

    def planes(self, sweeps: Sweeps, rows: NDArray[np.int64], heading_rad: NDArray[np.float64]) -> Tensor:  # noqa: ARG002 (none is needed)
        """Return planes of whole panoramas; see ``LidarViews``.

        Args:
            sweeps: LiDAR frames.
            rows: rows of ``sweeps`` (B,).
            heading_rad: unused.
        """
        return lidar_planes(sweeps.panoramas[rows][:, :, ::2], sweeps.intensities[rows][:, :, ::2])


class CameraField:
    """A level camera's image plane: z in metres of the panorama cell nearest to each pixel's ray.

    Args:
        camera: camera of the views.
        grid: view grid of the panoramas.
    """

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
        """Return planes of the camera's view; see ``LidarViews``.

        Args:
            sweeps: LiDAR frames.
            rows: rows of ``sweeps`` (B,).
            heading_rad: heading of each view (B,) against the panorama's x axis, radians.
        """
        turned = heading_rad[:, None, None] * (self._around / (2 * np.pi))
        column = np.rint(self._column + turned).astype(np.int64) % self._around
        cells = (rows[:, None, None], self._row, column)
        return lidar_planes(
            sweeps.panoramas[cells] * (self._z_of_range * self._inside), sweeps.intensities[cells] * self._inside
        )


def fan(views: LidarViews) -> NDArray[np.float64]:
    """Return the headings of a place's views (headings,), radians against the panorama's x axis.

    Args:
        views: kind of the views.
    """
    return np.linspace(0.0, 2 * np.pi, views.headings, endpoint=False)
