"""The pinhole camera. Pixels are (u, v) with the centre of the first pixel at (0, 0)."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class PinholeCamera:
    """Intrinsics of a rectified camera, pixels; ``distortion`` (OpenCV order) is for pictures not yet rectified."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()

    @property
    def matrix(self) -> Float64[NDArray[np.float64], "3 3"]:
        """K."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def scaled_to(self, width: int, height: int) -> "PinholeCamera":
        """The same camera with its picture resized; pixel centres, not corners, are at whole numbers."""
        sx, sy = width / self.width, height / self.height
        return PinholeCamera(
            width,
            height,
            self.fx * sx,
            self.fy * sy,
            (self.cx + 0.5) * sx - 0.5,
            (self.cy + 0.5) * sy - 0.5,
            self.distortion,
        )

    def rays_of_pixels(self) -> Float64[NDArray[np.float64], "H W 3"]:
        """Directions with z = 1 in the optical frame through every pixel's centre (no distortion)."""
        u, v = np.meshgrid(np.arange(self.width), np.arange(self.height))
        return np.stack([(u - self.cx) / self.fx, (v - self.cy) / self.fy, np.ones(u.shape)], axis=-1)
